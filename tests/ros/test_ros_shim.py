"""Imports resolve to the kit, in a process of their own; genuine rclpy takes precedence."""

from __future__ import annotations

import subprocess
import sys
import textwrap


def run(code, tmp_path, **files):
    for name, text in files.items():
        target = (
            tmp_path
            / {"student_py": "student.py", "rclpy": "rclpy/__init__.py", "std_msgs": "std_msgs/__init__.py"}[name]
        )
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(textwrap.dedent(text), encoding="utf-8")
    process = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n" + textwrap.dedent(code)],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


STUDENT = """
    import rclpy
    from geometry_msgs.msg import Twist
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import LaserScan
    from std_srvs.srv import Trigger


    class Brain(Node):
        def __init__(self):
            super().__init__("brain")
            self.declare_parameter("gain", 0.5)
            self.publisher = self.create_publisher(Twist, "cmd_vel", 10)
            self.create_subscription(LaserScan, "scan", self.on_scan, qos_profile_sensor_data)
            self.create_service(Trigger, "stop", self.on_stop)
            self.stopped = False

        def on_scan(self, scan):
            twist = Twist()
            gain = self.get_parameter("gain").value
            twist.linear.x = 0.0 if self.stopped else gain * (min(scan.ranges) - 1.0)
            self.publisher.publish(twist)

        def on_stop(self, request, response):
            self.stopped = response.success = True
            self.get_logger().info("stopping")
            return response


    def main(args=None):
        rclpy.init(args=args)
        node = Brain()
        try:
            rclpy.spin(node)
        except rclpy.executors.ExternalShutdownException:
            pass
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
"""


def test_a_student_program_closes_the_loop(tmp_path):
    """x' = -0.5 (5 - x - 1) stepped at 10 Hz: the discrete solution is (x* - x) shrinking by 0.95 a step."""
    out = run(
        """
        import robotbrain.ros as ros
        from robotbrain.ros import SimContext
        context = SimContext()
        with context.as_default():
            import student
            from geometry_msgs.msg import Twist
            from rclpy.node import Node
            from sensor_msgs.msg import LaserScan
            from std_srvs.srv import Trigger
            world = Node("world")
            state = {"x": 0.0, "v": 0.0}
            scans = world.create_publisher(LaserScan, "scan", 10)
            world.create_subscription(Twist, "cmd_vel", lambda m: state.update(v=m.linear.x), 10)
            def step():
                state["x"] += state["v"] * 0.1
                scans.publish(LaserScan(ranges=[5.0 - state["x"]] * 120))
            world.create_timer(0.1, step)
            client = world.create_client(Trigger, "stop")
            def stop():
                timer.cancel()
                client.call_async(Trigger.Request())
            timer = world.create_timer(5.05, stop)
            context.horizon_ns = 6_000_000_000
            student.main()
        print(ros.BACKEND, context.now_ns, round(state["x"], 5), state["v"])
        """,
        tmp_path,
        student_py=STUDENT,
    )
    log, result = out.splitlines()
    assert log == "[INFO] [5.050000000] [brain]: stopping"
    backend, now, x, v = result.split()
    assert (backend, now, float(v)) == ("kit", "6000000000", 0.0)
    # Steps 2..51 move; the last command before the stop still acts in step 51.
    assert abs(float(x) - 4.0 * (1 - 0.95**50)) < 1e-4


def test_imports_and_type_identity(tmp_path):
    out = run(
        """
        import robotbrain.ros
        import rclpy, geometry_msgs.msg, nav_msgs.srv, tf2_msgs.msg
        from geometry_msgs.msg import Twist
        from robotbrain.ros.messages import message_class
        from rclpy.qos import QoSProfile, QoSReliabilityPolicy
        from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
        from rclpy.callback_groups import ReentrantCallbackGroup
        from rclpy.parameter import Parameter
        from rclpy.clock import Clock, ClockType, ROSClock
        from rclpy.task import Future
        from nav_msgs.srv import GetPlan
        assert Twist is geometry_msgs.msg.Twist is message_class("geometry_msgs/msg/Twist")
        assert type(Twist().linear) is geometry_msgs.msg.Vector3
        assert rclpy.qos.QoSProfile is QoSProfile and rclpy.node.Node is rclpy.Node
        assert GetPlan.Request is nav_msgs.srv.GetPlan_Request
        assert issubclass(ExternalShutdownException, Exception) and rclpy.Parameter is Parameter
        from std_msgs.msg import *
        assert String(data="a").data == "a"
        try:
            from geometry_msgs.msg import Twirl
        except ImportError:
            pass
        else:
            raise AssertionError
        for absent in ("std_msgs.srv", "std_srvs.msg", "my_msgs", "rclpy.nothing", "geometry_msgs.msg.deep"):
            try:
                __import__(absent)
            except ImportError:
                continue
            raise AssertionError(absent)
        robotbrain.ros.uninstall()
        assert robotbrain.ros.BACKEND == "" and "geometry_msgs" not in sys.modules
        try:
            import rclpy
        except ImportError:
            pass
        else:
            raise AssertionError
        assert robotbrain.ros.install() == "kit"
        from geometry_msgs.msg import Twist as Again
        assert Again is Twist
        print("ok")
        """,
        tmp_path,
    )
    assert out == "ok"


def test_steps_aside_for_genuine_rclpy_unless_forced(tmp_path):
    """A package called rclpy on the path stands for the genuine one."""
    out = run(
        """
        import robotbrain.ros as ros
        import rclpy
        print(ros.BACKEND, rclpy.MARK)
        del sys.modules["rclpy"]
        print(ros.install(force=True))
        import rclpy
        print(hasattr(rclpy, "MARK"), rclpy.spin.__module__)
        """,
        tmp_path,
        rclpy="MARK = 'genuine'\n",
    )
    assert out.splitlines() == ["rclpy genuine", "kit", "False robotbrain.ros.api"]


def test_an_installed_message_package_is_found_first(tmp_path):
    out = run("import robotbrain.ros, std_msgs; print(std_msgs.MARK)", tmp_path, std_msgs="MARK = 'installed'\n")
    assert out == "installed"


def test_import_loads_no_heavy_library(tmp_path):
    out = run(
        """
        import robotbrain.ros
        heavy = ("rosbags", "torch", "mujoco", "scipy", "onnxruntime", "matplotlib")
        print([name for name in heavy if name in sys.modules])
        """,
        tmp_path,
    )
    assert out == "[]"
