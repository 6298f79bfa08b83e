"""Values that genuine messages take when they do not check them, which is how they come: converted, not refused."""

import numpy as np
from conformance import attempt
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import Image, Imu, JointState, LaserScan


def described(message, field: str) -> list:
    value = getattr(message, field)
    return [type(value).__name__, getattr(value, "typecode", None) or str(getattr(value, "dtype", "")), value]


def main() -> None:
    cases = {
        LaserScan: ("ranges", {
            "ints": [1, 2], "floats and ints": [1, 0.5], "float64 array": np.array([1.0, 2.5]),
            "float32 array": np.array([1.0, 0.1], dtype=np.float32), "generator": (x / 2 for x in range(3)),
            "range": range(3), "numpy scalars": [np.float32(0.5), np.float64(0.25)], "view": np.arange(6.0)[::2],
        }),
        Imu: ("orientation_covariance", {
            "ints": [1] * 9, "float32": np.arange(9, dtype=np.float32), "numpy scalars": [np.float64(0.5)] * 9,
        }),
        Image: ("data", {
            "uint8 array": np.array([1, 255], dtype=np.uint8), "int array": np.array([1, 255]), "range": range(3),
        }),
        OccupancyGrid: ("data", {"int8 array": np.array([-1, 100], dtype=np.int8), "int array": np.array([-1, 0])}),
        JointState: ("position", {"ints": [1, 2], "float32 array": np.array([0.5], dtype=np.float32)}),
    }  # fmt: skip
    for cls, (field, values) in cases.items():
        for name, value in values.items():

            def assign(cls=cls, field=field, value=value):
                message = cls()
                setattr(message, field, value)
                return described(message, field)

            attempt(f"{cls.__name__} {name}", assign)


if __name__ == "__main__":
    main()
