"""Parameters of a node: declaring, overriding, reading, setting, types, ranges, read-only, undeclaring."""

from conformance import attempt, log, ros
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterType
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python

ARGUMENTS = [
    "--ros-args", "-p", "speed:=2.5", "-p", "tuned.gain:=3", "-p", "frames:=[a, b]", "-p", "flag:=true",
    "-p", "wrong:=text", "-p", "node:only:=7", "-p", "elsewhere:only:=8", "-p", "never_declared:=1",
]  # fmt: skip


def shown(parameter: Parameter) -> list:
    return [parameter.name, parameter.type_.name, parameter.value]


def results(answers) -> list:
    return [[answer.successful, bool(answer.reason)] for answer in answers]


def declaring(node: Node) -> None:
    for name, value in {
        "an_int": 1, "a_float": 0.5, "a_bool": True, "a_text": "x", "ints": [1, 2], "floats": [0.5, 1.5],
        "bools": [True], "texts": ["a", "b"], "raw": [b"\x01", b"\x02"],
    }.items():  # fmt: skip
        attempt("declare", lambda n=name, v=value: shown(node.declare_parameter(n, v)))
    attempt("declare again", lambda: node.declare_parameter("an_int", 2))
    attempt("declare by type", lambda: shown(node.declare_parameter("typed", Parameter.Type.DOUBLE)))
    attempt("read it without a value", lambda: shown(node.get_parameter("typed")))
    attempt("read it or", lambda: shown(node.get_parameter_or("typed", Parameter("other", value=1))))
    attempt("set it", lambda: results(node.set_parameters([Parameter("typed", value=1.5)])))
    attempt("read it with a value", lambda: shown(node.get_parameter("typed")))
    attempt("mixed list", lambda: node.declare_parameter("mixed", [1, "a"]) and None)
    attempt("a dict", lambda: node.declare_parameter("a_dict", {}) and None)
    attempt("an empty name", lambda: node.declare_parameter("", 1) and None)
    attempt("overridden", lambda: shown(node.declare_parameter("speed", 1.0)))
    attempt("overridden but ignored", lambda: shown(node.declare_parameter("flag", False, ignore_override=True)))
    attempt("overridden list", lambda: shown(node.declare_parameter("frames", ["z"])))
    attempt("override of another type", lambda: shown(node.declare_parameter("wrong", 1)))
    attempt("override of this node", lambda: shown(node.declare_parameter("only", 0)))
    declared = node.declare_parameters("tuned", [("gain", 1), ("bias", 0.5), ("name", "n", ParameterDescriptor())])
    log("several", parameters=[shown(parameter) for parameter in declared])
    log("by prefix", found={key: value.value for key, value in node.get_parameters_by_prefix("tuned").items()})
    log("has", known=node.has_parameter("tuned.bias"), unknown=node.has_parameter("bias"))
    log("has what was only given", value=node.has_parameter("never_declared"))


def reading(node: Node) -> None:
    attempt("unknown", lambda: node.get_parameter("unknown"))
    attempt("unknown or", lambda: shown(node.get_parameter_or("unknown", Parameter("instead", value=3))))
    attempt("unknown or nothing", lambda: shown(node.get_parameter_or("unknown")))
    attempt("several", lambda: [shown(p) for p in node.get_parameters(["an_int", "a_text"])])
    attempt("type", lambda: int(node.get_parameter_type("an_int")))
    attempt("types", lambda: [int(kind) for kind in node.get_parameter_types(["an_int", "floats"])])
    message = node.get_parameter("a_float").get_parameter_value()
    log(
        "message",
        kind=message.type,
        is_double=message.type == ParameterType.PARAMETER_DOUBLE,
        value=message.double_value,
    )
    log("to python", value=parameter_value_to_python(node.get_parameter("texts").get_parameter_value()))


def setting(node: Node) -> None:
    attempt("set", lambda: results(node.set_parameters([Parameter("an_int", value=5), Parameter("a_text", value="y")])))
    log("is set", an_int=node.get_parameter("an_int").value, a_text=node.get_parameter("a_text").value)
    attempt("another type", lambda: results(node.set_parameters([Parameter("an_int", value="five")])))
    attempt("int for a double", lambda: results(node.set_parameters([Parameter("a_float", value=2)])))
    log("is kept", an_int=node.get_parameter("an_int").value, a_float=node.get_parameter("a_float").value)
    attempt("set an unknown", lambda: node.set_parameters([Parameter("unknown", value=1)]))
    attempt("first is set, second fails", lambda: results(
        node.set_parameters([Parameter("an_int", value=6), Parameter("a_bool", value=3)])))  # fmt: skip
    log("first was set", an_int=node.get_parameter("an_int").value, a_bool=node.get_parameter("a_bool").value)
    attempt("all or none", lambda: results(
        [node.set_parameters_atomically([Parameter("an_int", value=7), Parameter("a_bool", value=3)])]))  # fmt: skip
    log("none was set", an_int=node.get_parameter("an_int").value)
    attempt("parameter of wrong type", lambda: Parameter("p", Parameter.Type.DOUBLE, 1))
    attempt("parameter of a dict", lambda: Parameter("p", value={}))
    attempt("equal", lambda: Parameter("p", value=1) == Parameter("p", Parameter.Type.INTEGER, 1))
    attempt("set a non-parameter", lambda: node.set_parameters(["an_int"]))
    both_ways = Parameter.from_parameter_msg(Parameter("p", value=[1, 2]).to_parameter_msg())
    log("message both ways", parameter=[both_ways.name, both_ways.type_.name, list(both_ways.value)])
    log("undeclare", result=node.undeclare_parameter("a_bool"), has=node.has_parameter("a_bool"))
    attempt("undeclare again", lambda: node.undeclare_parameter("a_bool"))
    attempt("unset", lambda: results(node.set_parameters([Parameter("an_int")])))
    attempt("after unsetting", lambda: node.get_parameter("an_int").value)


def describing(node: Node) -> None:
    fixed = ParameterDescriptor(description="cannot change", read_only=True)
    node.declare_parameter("fixed", 3, fixed)
    attempt("read-only", lambda: results(node.set_parameters([Parameter("fixed", value=4)])))
    log("read-only value", value=node.get_parameter("fixed").value)
    attempt("undeclare read-only", lambda: node.undeclare_parameter("fixed"))
    bounded = ParameterDescriptor(integer_range=[IntegerRange(from_value=0, to_value=10, step=2)])
    attempt("in range", lambda: shown(node.declare_parameter("even", 4, bounded)))
    attempt("out of range default", lambda: node.declare_parameter("outside", 11, bounded) and None)
    for value in (10, 11, 3, -2, 0):
        attempt("range", lambda v=value: results(node.set_parameters([Parameter("even", value=v)])), value=value)
    smooth = ParameterDescriptor(floating_point_range=[FloatingPointRange(from_value=-1.0, to_value=1.0, step=0.0)])
    node.declare_parameter("ratio", 0.0, smooth)
    for value in (1.0, 1.0001, -0.3):
        attempt("float range", lambda v=value: results(node.set_parameters([Parameter("ratio", value=v)])), value=value)
    stepped = ParameterDescriptor(floating_point_range=[FloatingPointRange(from_value=0.0, to_value=1.0, step=0.25)])
    node.declare_parameter("quarter", 0.5, stepped)
    for value in (0.75, 0.6):
        attempt(
            "float step", lambda v=value: results(node.set_parameters([Parameter("quarter", value=v)])), value=value
        )
    anything = ParameterDescriptor(dynamic_typing=True)
    node.declare_parameter("anything", 1, anything)
    attempt("dynamic", lambda: results(node.set_parameters([Parameter("anything", value="text")])))
    log("dynamic value", value=node.get_parameter("anything").value)
    attempt("no value, no type", lambda: shown(node.declare_parameter("nothing")))
    attempt("no value, dynamic", lambda: shown(node.declare_parameter("nothing_dynamic", None, anything)))
    found = node.describe_parameter("even")
    log("descriptor", name=found.name, kind=found.type, read_only=found.read_only, step=found.integer_range[0].step)
    attempt("descriptors", lambda: [d.name for d in node.describe_parameters(["even", "ratio"])])
    attempt("describe unknown", lambda: node.describe_parameter("unknown"))
    attempt("new descriptor", lambda: shown_value(node.set_descriptor("even", ParameterDescriptor())))
    attempt("now odd", lambda: results(node.set_parameters([Parameter("even", value=3)])))


def shown_value(value) -> list:
    return [value.type, value.integer_value]


def main() -> None:
    node = Node("node")
    log("at first", use_sim_time=node.has_parameter("use_sim_time"))
    for part in (declaring, reading, setting, describing):
        part(node)

    loose = Node("loose", allow_undeclared_parameters=True)
    attempt("undeclared", lambda: shown(loose.get_parameter("unknown")))
    attempt("set undeclared", lambda: results(loose.set_parameters([Parameter("fresh", value=1)])))
    attempt("read it", lambda: shown(loose.get_parameter("fresh")))

    eager = Node("eager", automatically_declare_parameters_from_overrides=True)
    attempt("declared by override", lambda: shown(eager.get_parameter("speed")))
    own = Node("own", parameter_overrides=[Parameter("speed", value=9.0)])
    attempt("own override", lambda: shown(own.declare_parameter("speed", 1.0)))


if __name__ == "__main__":
    with ros(ARGUMENTS):
        main()
