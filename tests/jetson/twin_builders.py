"""A calibration run in a moment: the stored fit stands in for the many that cross-validation makes."""

from __future__ import annotations

from robotbrain.jetson.catalogue import load_module
from robotbrain.jetson.twin.calibrate import SIBLINGS, CalibrationRun, load_calibration
from robotbrain.jetson.twin.conditions import PRECISIONS
from robotbrain.jetson.twin.data import load_kernel_lists, load_latency_rows, load_power_rows
from robotbrain.jetson.twin.latency import make_work
from robotbrain.jetson.twin.power import use_of
from robotbrain.jetson.twin.validate import LeftOut


def quick_run() -> CalibrationRun:
    """Return a run of the right shape with all rows, whose errors are those of the fit to all of them."""
    calibration, lists = load_calibration(), load_kernel_lists()
    rows = load_latency_rows()
    works = [make_work(lists[row.kernels], row.where) for row in rows]
    predicted = calibration.latency.predict_ms(works, [row.where for row in rows])
    left_out = []
    for row, work, ms in zip(rows, works, predicted, strict=True):
        peak_ms = 2e3 * lists[row.kernels].macs / row.where.peak[PRECISIONS.index(row.precision)]
        left_out.append(LeftOut(row, float(ms), calibration.latency.log_sd(work, row.where), 3 * peak_ms))
    transfer = {slug: [item for item in left_out if item.row.module == slug] for slug in SIBLINGS}
    power = [
        (row, calibration.power.wall_w(load_module(row.module), row.mode, use_of(row)) / row.wall_power_w - 1)
        for row in load_power_rows()
    ]
    return CalibrationRun(calibration, left_out, transfer, power)
