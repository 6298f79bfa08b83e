"""Callbacks before, at and after a change: what they see, in which order, and what they can refuse or add."""

from conformance import attempt, log, ros
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter


def main() -> None:
    node = Node("node")
    node.declare_parameter("speed", 1.0)
    node.declare_parameter("limit", 2.0)
    trace: list[list] = []

    def names(parameters) -> list:
        return [[parameter.name, parameter.value] for parameter in parameters]

    def values() -> list:
        return [node.get_parameter("speed").value, node.get_parameter("limit").value]

    def before(parameters):
        trace.append(["before", names(parameters)])
        # A speed given alone brings its limit along.
        if [parameter.name for parameter in parameters] == ["speed"]:
            return [*parameters, Parameter("limit", value=parameters[0].value + 1.0)]
        return parameters

    def check(parameters) -> SetParametersResult:
        trace.append(["check", names(parameters), values()])
        if any(parameter.value < 0 for parameter in parameters):
            return SetParametersResult(successful=False, reason="negative")
        return SetParametersResult(successful=True)

    def second_check(parameters) -> SetParametersResult:
        trace.append(["second check", names(parameters)])
        return SetParametersResult(successful=not any(parameter.value > 100 for parameter in parameters))

    def after(parameters) -> None:
        trace.append(["after", names(parameters), values()])

    def change(event: str, *parameters: Parameter, atomically: bool = False) -> None:
        trace.clear()
        if atomically:
            answers = [node.set_parameters_atomically(list(parameters))]
        else:
            answers = node.set_parameters(list(parameters))
        log(event, results=[[a.successful, a.reason] for a in answers], trace=trace, values=values())

    node.add_on_set_parameters_callback(check)
    change("one callback", Parameter("speed", value=1.5))
    change("refused", Parameter("speed", value=-1.0))
    change("one by one", Parameter("speed", value=3.0), Parameter("limit", value=-4.0))
    change("atomically", Parameter("speed", value=5.0), Parameter("limit", value=-4.0), atomically=True)
    node.add_on_set_parameters_callback(second_check)
    change("two callbacks", Parameter("speed", value=1.0))
    change("first refuses", Parameter("speed", value=-2.0))
    change("second refuses", Parameter("speed", value=200.0))
    node.add_pre_set_parameters_callback(before)
    node.add_post_set_parameters_callback(after)
    change("all", Parameter("speed", value=7.0))
    change("all, refused", Parameter("speed", value=-7.0))
    change("all, atomically", Parameter("speed", value=1.0), Parameter("limit", value=2.0), atomically=True)
    trace.clear()
    attempt("declaring asks, too", lambda: node.declare_parameter("extra", -3.0) and None)
    log("trace of declaring", trace=trace, has=node.has_parameter("extra"))
    for remove, callback in (
        (node.remove_pre_set_parameters_callback, before),
        (node.remove_on_set_parameters_callback, check),
        (node.remove_on_set_parameters_callback, second_check),
        (node.remove_post_set_parameters_callback, after),
    ):
        attempt("remove", lambda r=remove, c=callback: r(c))
    change("none left", Parameter("speed", value=-5.0))
    attempt("remove twice", lambda: node.remove_on_set_parameters_callback(check))


if __name__ == "__main__":
    with ros():
        main()
