"""A policy file computes what the module computes, says what it means, and cannot harm who loads it."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper
from torch import nn

import robotbrain.rl
from robotbrain.errors import InputError, RobotBrainError
from robotbrain.rl.export import OPSET, OnnxPolicy, PolicyMeta, export_policy, policy_bytes
from robotbrain.rl.onnx_policy import MAX_BYTES, checked_model

META = PolicyMeta(
    "reach",
    (("joint_pos", 3), ("target", 2)),
    0.04,
    "held_relative_joint_position",
    joint_names=("joint1", "joint2"),
    action_scale=(0.3, 0.2),
    action_low=(-1.0, -1.0),
    action_high=(1.0, 1.0),
    default_joint_pos=(0.1, -0.2),
    provenance={"seed": 0, "curve": [0.1, 0.9]},
)


def mlp(*, seed: int = 0, inputs: int = 5, outputs: int = 2) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(inputs, 32), nn.ELU(), nn.Linear(32, outputs), nn.Tanh())


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_policy(mlp(), tmp_path_factory.mktemp("policy") / "policy.onnx", META, obs_dim=5)


class TestExport:
    def test_computes_what_torch_computes_with_the_normaliser(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(1)
        mean, std = rng.normal(0, 3, 5), rng.uniform(0.5, 4, 5)
        path = export_policy(mlp(), tmp_path / "p.onnx", META, normaliser=(mean, std))
        obs = rng.normal(0, 5, (130, 5)).astype(np.float32)
        with torch.no_grad():
            expected = mlp()(torch.as_tensor((obs - mean) / std, dtype=torch.float32)).numpy()
        assert np.abs(OnnxPolicy(path)(obs) - expected).max() < 1e-5

    def test_same_module_same_bytes_and_the_opset_asked_for(self, file: Path) -> None:
        assert policy_bytes(mlp(), META) == file.read_bytes()
        model = onnx.load(file)
        assert [(o.domain, o.version) for o in model.opset_import] == [("", OPSET)]
        assert [n.op_type for n in model.graph.node] == ["Gemm", "Elu", "Gemm", "Tanh"]
        assert model.graph.input[0].name == "obs" and model.graph.output[0].name == "actions"

    def test_metadata_is_json_under_the_names_of_the_field(self, file: Path) -> None:
        stored = {p.key: json.loads(p.value) for p in onnx.load(file).metadata_props}
        assert stored["joint_names"] == ["joint1", "joint2"]
        assert stored["observation_names"] == ["joint_pos", "target"] and stored["observation_dims"] == [3, 2]
        assert stored["action_scale"] == [0.3, 0.2] and stored["default_joint_pos"] == [0.1, -0.2]
        assert OnnxPolicy(file).meta == META

    def test_the_module_is_left_as_it_was(self) -> None:
        module = nn.Sequential(nn.Linear(5, 2), nn.Dropout(0.5)).double().train()
        policy_bytes(module, META)
        assert module.training and module[1].training and module[0].weight.dtype == torch.float64

    def test_convolutions_over_a_scan_are_clean_graphs_too(self, tmp_path: Path) -> None:
        class Scan(nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.conv, self.norm, self.head = nn.Conv1d(1, 4, 3, 2, 1), nn.LayerNorm(12), nn.Linear(12, 2)

            def forward(self, obs: torch.Tensor) -> torch.Tensor:
                hidden = torch.relu(self.conv(obs[:, None]))
                return torch.clamp(self.head(self.norm(hidden.view(hidden.size(0), -1))), -1.0, 1.0)

        policy = OnnxPolicy(export_policy(Scan(), tmp_path / "p.onnx", META))
        assert policy(np.ones((3, 5))).shape == (3, 2)

    @pytest.mark.parametrize("module", [mlp(inputs=6), mlp(outputs=3), nn.LSTM(5, 2)])
    def test_sizes_that_disagree_are_refused(self, module: nn.Module, tmp_path: Path) -> None:
        with pytest.raises(InputError):
            export_policy(module, tmp_path / "p.onnx", META)
        assert not list(tmp_path.iterdir())

    def test_a_module_with_random_numbers_is_refused(self, tmp_path: Path) -> None:
        class Noisy(nn.Module):
            def forward(self, obs: torch.Tensor) -> torch.Tensor:
                return obs[:, :2] + torch.rand(2)

        with pytest.raises(RobotBrainError):
            export_policy(Noisy(), tmp_path / "p.onnx", META)

    def test_a_module_that_treats_large_batches_differently_is_refused(self) -> None:
        class Branching(nn.Module):
            def forward(self, obs: torch.Tensor) -> torch.Tensor:
                return obs[:, :2] if len(obs) < 4 else -obs[:, :2]

        with pytest.raises(RobotBrainError, match="differs from the module"):
            policy_bytes(Branching(), META)

    def test_a_normaliser_that_divides_by_zero_is_refused(self) -> None:
        with pytest.raises(InputError, match="standard deviation"):
            policy_bytes(mlp(), META, normaliser=(np.zeros(5), np.zeros(5)))


class TestMeta:
    @pytest.mark.parametrize("key", ["format", "task", "observation_dims", "control_dt", "action_names"])
    def test_every_key_that_is_needed_is_asked_for(self, key: str) -> None:
        with pytest.raises(InputError, match=f"'{key}'"):
            PolicyMeta.from_metadata({k: v for k, v in META.to_metadata().items() if k != key})

    def test_another_format_is_refused(self) -> None:
        with pytest.raises(InputError, match="'format'"):
            PolicyMeta.from_metadata({**META.to_metadata(), "format": '"robotbrain-policy/9"'})

    def test_commands_follow_the_kind(self) -> None:
        q = np.array([[1.0, 2.0]])
        assert META.commands([[5.0, -0.5]], q) == pytest.approx(np.array([[1.3, 1.9]]))
        absolute = PolicyMeta(**{**vars(META), "action_kind": "joint_position", "action_low": (), "action_high": ()})
        assert absolute.commands([2.0, 1.0]) == pytest.approx([0.1 + 0.6, -0.2 + 0.2])
        with pytest.raises(InputError, match="joint angles"):
            META.commands([0.0, 0.0])

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("control_dt", 0.0),
            ("control_dt", float("nan")),
            ("action_kind", "telepathy"),
            ("action_scale", (1.0, 2.0, 3.0)),
            ("action_low", (2.0, -1.0)),
            ("default_joint_pos", ("a", "b")),
            ("joint_names", ("same", "same")),
            ("observation_names", (("joint_pos", 0),)),
            ("observation_names", ()),
            ("observation_scales", ((1.0,),)),
            ("provenance", {"loss": float("inf")}),
            ("provenance", {"when": object()}),
        ],
    )
    def test_impossible_values_are_refused(self, field: str, value: object) -> None:
        with pytest.raises(InputError, match="policy metadata"):
            PolicyMeta(**{**vars(META), field: value})

    @given(
        st.dictionaries(
            st.sampled_from(sorted(META.to_metadata())),
            st.one_of(
                st.text(max_size=8), st.sampled_from(["[[[", "1" * 400, "NaN", "null", "{}", "[]", "[1,2]", "true"])
            ),
            min_size=1,
        )
    )
    @settings(max_examples=150, deadline=None)
    def test_any_metadata_is_read_or_refused_with_words(self, damage: dict[str, str]) -> None:
        try:
            PolicyMeta.from_metadata({**META.to_metadata(), **damage})
        except InputError as error:
            assert "policy metadata" in str(error)


def graph_file(tmp_path: Path, nodes: list[onnx.NodeProto], weights: dict[str, np.ndarray], **changes: object) -> Path:
    """A hand-made file with the metadata of META."""
    shape = changes.pop("output", ["batch", 2])
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, changes.pop("input", ["batch", 5]))],
        [helper.make_tensor_value_info("actions", TensorProto.FLOAT, shape)],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )
    opset = changes.pop("opset", helper.make_opsetid("", 17))
    model = helper.make_model(graph, opset_imports=[opset], ir_version=8, **changes)
    helper.set_model_props(model, META.to_metadata())
    (tmp_path / "hostile.onnx").write_bytes(model.SerializeToString())
    return tmp_path / "hostile.onnx"


HEAD = helper.make_node("MatMul", ["obs", "w"], ["actions"])
W = {"w": np.ones((5, 2), np.float32)}


class TestStrangers:
    def test_a_hand_made_file_of_the_right_form_is_taken(self, tmp_path: Path) -> None:
        assert OnnxPolicy(graph_file(tmp_path, [HEAD], W))(np.ones((1, 5))) == pytest.approx(np.full((1, 2), 5.0))

    def test_a_batch_fixed_at_one_row_is_asked_row_by_row(self, tmp_path: Path) -> None:
        policy = OnnxPolicy(graph_file(tmp_path, [HEAD], W, input=[1, 5], output=[1, 2]))
        assert policy(np.eye(5)).shape == (5, 2)

    def test_external_data_is_refused_before_any_file_is_opened(self, tmp_path: Path) -> None:
        path = graph_file(tmp_path, [HEAD], W)
        model = onnx.load(path)
        tensor = model.graph.initializer[0]
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="/dev/zero")
        path.write_bytes(model.SerializeToString())
        with pytest.raises(InputError, match="another file"):
            OnnxPolicy(path)

    def test_loops_and_random_numbers_and_foreign_operators_are_refused(self, tmp_path: Path) -> None:
        for node in (
            helper.make_node("RandomUniformLike", ["obs"], ["actions"]),
            helper.make_node("Gemm", ["obs", "w"], ["actions"], domain="com.microsoft"),
            helper.make_node("If", ["obs"], ["actions"], then_branch=helper.make_graph([], "t", [], [])),
        ):
            with pytest.raises(InputError, match="operator of the policy"):
                OnnxPolicy(graph_file(tmp_path, [node], W))

    @pytest.mark.parametrize("batch", [1, "batch"])
    def test_a_small_file_cannot_ask_for_much_memory(self, tmp_path: Path, batch: object) -> None:
        tall, wide = np.ones((20_000, 1), np.float32), np.ones((1, 20_000), np.float32)
        nodes = [
            helper.make_node("Add", ["tall", "wide"], ["huge"]),  # 400 million numbers from 160 kB
            helper.make_node("ReduceMax", ["huge"], ["top"], keepdims=1),
            helper.make_node("MatMul", ["obs", "w"], ["y"]),
            helper.make_node("Add", ["y", "top"], ["actions"]),
        ]
        weights = {**W, "tall": tall, "wide": wide}
        with pytest.raises(InputError, match="numbers"):
            OnnxPolicy(graph_file(tmp_path, nodes, weights, input=[batch, 5], output=[batch, 2]))

    def test_rows_of_a_batch_must_not_be_multiplied_with_each_other(self, tmp_path: Path) -> None:
        nodes = [
            helper.make_node("Transpose", ["obs"], ["columns"]),
            helper.make_node("MatMul", ["obs", "columns"], ["square"]),
            helper.make_node("ReduceMax", ["square"], ["top"], axes=[1], keepdims=1),
            helper.make_node("MatMul", ["obs", "w"], ["y"]),
            helper.make_node("Add", ["y", "top"], ["actions"]),
        ]
        with pytest.raises(InputError, match="other rows"):
            OnnxPolicy(graph_file(tmp_path, nodes, W))

    def test_much_work_is_refused(self, tmp_path: Path) -> None:
        square = np.zeros((1500, 1500), np.float32)
        nodes = [helper.make_node("MatMul", ["obs", "first"], ["h0"])]
        nodes += [helper.make_node("MatMul", [f"h{i}", "square"], [f"h{i + 1}"]) for i in range(40)]
        nodes += [helper.make_node("MatMul", ["h40", "last"], ["actions"])]
        weights = {"first": np.zeros((5, 1500), np.float32), "square": square, "last": np.zeros((1500, 2), np.float32)}
        with pytest.raises(InputError, match="operations"):
            OnnxPolicy(graph_file(tmp_path, nodes, weights))

    @pytest.mark.parametrize("count", [2, 30])
    def test_many_results_of_medium_size_are_too_much_memory_together(self, tmp_path: Path, count: int) -> None:
        weights = {"w": np.ones((5, 2)), "tall": np.ones((2000, 1)), "wide": np.ones((1, 2000))}
        nodes = [
            helper.make_node("Cast", ["obs"], ["x"], to=TensorProto.DOUBLE),
            helper.make_node("ReduceMax", ["x"], ["one"], keepdims=1),
            helper.make_node("Mul", ["tall", "one"], ["column"]),
            *(helper.make_node("Mul", ["column", "wide"], [f"big{i}"]) for i in range(count)),  # 32 MB each
            helper.make_node("Max", [f"big{i}" for i in range(count)], ["all"]),
            helper.make_node("ReduceMax", ["all"], ["top"], keepdims=1),
            helper.make_node("MatMul", ["x", "w"], ["y"]),
            helper.make_node("Add", ["y", "top"], ["z"]),
            helper.make_node("Cast", ["z"], ["actions"], to=TensorProto.FLOAT),
        ]
        data = graph_file(tmp_path, nodes, weights).read_bytes()
        assert len(data) < 50_000
        if count == 2:
            checked_model(data)
            return
        with pytest.raises(InputError, match="numbers in all nodes' outputs"):
            checked_model(data)

    def test_slow_functions_repeated_reading_and_single_rows_are_work(self, tmp_path: Path) -> None:
        weights = {"many": np.zeros((5, 100_000), np.float32), "last": np.zeros((100_000, 2), np.float32)}

        def chain(op: str) -> Path:
            nodes = [helper.make_node("MatMul", ["obs", "many"], ["h0"])]
            nodes += [helper.make_node(op, [f"h{i}"], [f"h{i + 1}"]) for i in range(14)]
            nodes.append(helper.make_node("MatMul", ["h14", "last"], ["actions"]))
            return graph_file(tmp_path, nodes, weights, input=[1, 5], output=[1, 2])

        checked_model(chain("Relu").read_bytes())
        with pytest.raises(InputError, match="operations"):
            checked_model(chain("Erf").read_bytes())

        def reading(times: int, batch: object) -> bytes:
            weights = {**W, "much": np.zeros((1, 1_000_000), np.float32)}
            nodes = [helper.make_node("MatMul", ["obs", "w"], ["y0"])]
            for i in range(times):
                nodes.append(helper.make_node("ReduceMax", ["much"], [f"top{i}"], axes=[1], keepdims=1))
                nodes.append(
                    helper.make_node("Add", [f"y{i}", f"top{i}"], [f"y{i + 1}" if i + 1 < times else "actions"])
                )
            return graph_file(tmp_path, nodes, weights, input=[batch, 5], output=[batch, 2]).read_bytes()

        checked_model(reading(20, "batch"))
        with pytest.raises(InputError, match="operations"):
            checked_model(reading(20, 1))  # is run 64 times for 64 observations

    def test_a_full_dense_network_and_the_shipped_policies_are_within_the_limits(self, tmp_path: Path) -> None:
        wide = 1995  # 16 MB of weights
        weights = {
            "a": np.zeros((5, wide), np.float32),
            "b": np.zeros((wide, wide), np.float32),
            "c": np.zeros((wide, 2), np.float32),
        }
        ends = ["obs", "h", "e", "g", "actions"]
        steps = zip(("MatMul", "Elu", "MatMul"), ends, ends[1:], strict=False)
        nodes = [helper.make_node(op, [x, *{"obs": "a", "e": "b"}.get(x, "")], [y]) for op, x, y in steps]
        nodes.append(helper.make_node("MatMul", ["g", "c"], ["actions"]))
        data = graph_file(tmp_path, nodes, weights).read_bytes()
        assert 0.95 * MAX_BYTES < len(data) < MAX_BYTES
        checked_model(data)
        shipped = sorted((Path(robotbrain.rl.__file__).parent / "weights").glob("*.onnx"))
        assert shipped
        for path in shipped:
            OnnxPolicy(path)

    def test_integer_division_is_refused(self, tmp_path: Path) -> None:
        nodes = [
            helper.make_node("Cast", ["obs"], ["whole"], to=TensorProto.INT64),
            helper.make_node("Div", ["whole", "zero"], ["crash"]),
            helper.make_node("Cast", ["crash"], ["back"], to=TensorProto.FLOAT),
            helper.make_node("MatMul", ["back", "w"], ["actions"]),
        ]
        with pytest.raises(InputError, match="Div of integers"):
            OnnxPolicy(graph_file(tmp_path, nodes, {**W, "zero": np.zeros(1, np.int64)}))

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"input": ["batch", 6]}, "shapes|width|valid"),
            ({"output": ["batch", 3]}, "shapes|valid"),
            ({"opset": helper.make_opsetid("", 9)}, "opset"),
            ({"opset": helper.make_opsetid("", 999)}, "opset"),
            ({"opset": helper.make_opsetid("com.microsoft", 1)}, "opset"),
            ({"input": [7, 5], "output": [7, 2]}, "batch"),
        ],
    )
    def test_wrong_shapes_and_opsets_are_refused(self, tmp_path: Path, changes: dict[str, object], words: str) -> None:
        with pytest.raises(InputError, match=words):
            OnnxPolicy(graph_file(tmp_path, [HEAD], W, **changes))

    def test_weights_that_are_not_finite_are_refused(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="NaN or infinity"):
            OnnxPolicy(graph_file(tmp_path, [HEAD], {"w": np.full((5, 2), np.nan, np.float32)}))

    def test_missing_metadata_is_named(self, file: Path, tmp_path: Path) -> None:
        model = onnx.load(file)
        del model.metadata_props[:]
        (tmp_path / "bare.onnx").write_bytes(model.SerializeToString())
        with pytest.raises(InputError, match="policy metadata 'format'"):
            OnnxPolicy(tmp_path / "bare.onnx")
        assert OnnxPolicy(tmp_path / "bare.onnx", meta=META).meta == META

    def test_files_that_are_none(self, tmp_path: Path, file: Path) -> None:
        empty, large = tmp_path / "empty.onnx", tmp_path / "large.onnx"
        empty.touch()
        with large.open("wb") as stream:
            stream.truncate(MAX_BYTES + 1)
        for path in (empty, large, tmp_path, tmp_path / "missing.onnx"):
            with pytest.raises(InputError, match="policy"):
                OnnxPolicy(path)
        with pytest.raises(InputError, match="1 to 100 bytes"):
            OnnxPolicy(file, max_bytes=100)

    @pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in the file system")
    def test_a_pipe_does_not_hang_the_reader(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "pipe.onnx")
        with pytest.raises(InputError, match="no regular file"):
            OnnxPolicy(tmp_path / "pipe.onnx")

    @given(
        damage=st.lists(st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)), max_size=4),
        kept=st.one_of(st.just(1.0), st.floats(0.0, 1.0)),
    )
    @settings(max_examples=120, deadline=None)
    def test_a_damaged_file_is_refused_or_still_a_policy(
        self, damage: list[tuple[float, int]], kept: float, file: Path, tmp_path_factory: pytest.TempPathFactory
    ) -> None:
        content = bytearray(file.read_bytes())
        for place, byte in damage:
            content[int(place * len(content))] = byte
        path = tmp_path_factory.getbasetemp() / "damaged.onnx"
        path.write_bytes(bytes(content[: int(kept * len(content))]))
        with contextlib.suppress(InputError):
            assert OnnxPolicy(path)(np.zeros((1, 5))).shape == (1, 2)


class TestCalls:
    def test_wrong_observations_are_refused_with_the_terms(self, file: Path) -> None:
        policy = OnnxPolicy(file)
        with pytest.raises(InputError, match=r"joint_pos \(3\), target \(2\)"):
            policy(np.zeros((2, 4)))
        with pytest.raises(InputError, match="NaN"):
            policy(np.full((1, 5), np.nan))
        assert policy(np.zeros((0, 5))).shape == (0, 2)

    def test_a_row_does_not_depend_on_its_batch(self, file: Path) -> None:
        policy, obs = OnnxPolicy(file), np.random.default_rng(0).normal(size=(150, 5)).astype(np.float32)
        alone = np.concatenate([policy(row[None]) for row in obs])
        assert policy(obs) == pytest.approx(alone, abs=1e-6)
