"""Quantisation-aware training: the grid asked for, what is trained is what is shipped, and it is worth it."""

from __future__ import annotations

import copy

import numpy as np
import onnx
import pytest
import torch
from torch import nn

from robotbrain.errors import InputError
from robotbrain.optimisation import qat
from robotbrain.optimisation.data import Scenes
from robotbrain.optimisation.distillation import DistilConfig, soft_targets_loss
from robotbrain.optimisation.evaluate import onnx_session
from robotbrain.optimisation.pt2e import pt2e
from robotbrain.optimisation.qdq_lint import lint
from robotbrain.optimisation.training import FitConfig

SIZE = (3, 8, 8)


class Tiny(nn.Module):
    """Convolutions with and without bias, batch norm with a telling eps, a skip, upsampling: what folding must know."""

    def __init__(self):
        super().__init__()
        self.a = nn.Sequential(nn.Conv2d(3, 8, 3, 1, 1, bias=False), nn.BatchNorm2d(8, eps=0.5), nn.ReLU(inplace=True))
        self.b = nn.Sequential(nn.Conv2d(8, 8, 3, 2, 1, groups=8), nn.BatchNorm2d(8), nn.ReLU(inplace=True))
        self.up = nn.Upsample(scale_factor=2)
        self.head = nn.Conv2d(16, 4, 1)

    def forward(self, image):
        one = self.a(image)
        return self.head(torch.cat([self.up(self.b(one)), one], dim=1))


def images(count=20, seed=0):
    return np.random.default_rng(seed).normal(size=(count, *SIZE)).astype(np.float32)


def trained(seed=0):
    """A network whose batch norms have seen data, with channels of very different ranges."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    network = Tiny()
    with torch.no_grad():
        network.b[1].weight.copy_(torch.logspace(-1.5, 0.5, 8))
        for _ in range(20):
            network(torch.from_numpy(images(32, seed)) * 2 + 1)
    return network.eval()


@pytest.fixture(scope="module")
def per_channel():
    return qat.calibrate(qat.prepare(trained(), torch.zeros(2, *SIZE)), images())


@pytest.fixture(scope="module")
def four_bits():
    network = qat.prepare(trained(), torch.zeros(2, *SIZE), weight_bits=4, per_channel=False)
    return qat.calibrate(network, images())


def output(network, x):
    with torch.no_grad():
        return network(torch.from_numpy(x)).numpy()


def test_folding_and_eight_bits_change_little(per_channel):
    original = trained()
    before = copy.deepcopy(original.state_dict())
    want, got = output(original, images()), output(per_channel, images())
    assert np.abs(got - want).max() < 0.03 * np.abs(want).max()
    assert not any(isinstance(m, nn.BatchNorm2d) for m in per_channel.modules())
    assert all(torch.equal(v, before[k]) for k, v in original.state_dict().items())


def test_weights_lie_on_the_grid_that_was_asked_for(per_channel, four_bits):
    """At most 2^b - 1 distinct values per scale, symmetric; per tensor one scale for all."""
    for network, largest in ((per_channel, 127), (four_bits, 7)):
        shipped = qat.convert(network)
        checked = 0
        for node in shipped.graph.nodes:
            if "fake_quantize" not in str(node.target) or node.args[0].op != "get_attr":
                continue
            weight = shipped.get_parameter(node.args[0].target).detach().numpy()
            rows = weight.reshape(1, -1) if largest == 7 else weight.reshape(len(weight), -1)
            for row in rows:
                steps = row / (np.abs(row).max() / largest)
                np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
                checked += 1
        assert checked == (3 if largest == 7 else 8 + 8 + 4)


@pytest.mark.parametrize("which", ["per_channel", "four_bits"])
def test_what_is_shipped_is_what_was_trained(which, request):
    network = request.getfixturevalue(which)
    x = images(seed=2)
    np.testing.assert_array_equal(output(qat.convert(network), x), output(network, x))


def test_torchaos_own_conversion_agrees(four_bits):
    """convert_pt2e is the peer: same grid, same network."""
    theirs = pt2e().convert_pt2e(copy.deepcopy(four_bits.graph), fold_quantize=False)
    x = images(seed=3)
    np.testing.assert_allclose(output(theirs, x), output(four_bits, x), atol=1e-5)


@pytest.mark.parametrize("which", ["per_channel", "four_bits"])
def test_the_file_is_tensorrt_safe_and_computes_the_same(which, request, tmp_path):
    network = request.getfixturevalue(which)
    path = qat.export_qat_onnx(network, tmp_path / "q.onnx", example=(1, *SIZE))
    assert lint(path) == []
    model = onnx.load(str(path))
    assert [(o.domain, o.version) for o in model.opset_import] == [("", 17)]
    assert {n.op_type for n in model.graph.node} <= {
        "QuantizeLinear", "DequantizeLinear", "Conv", "Relu", "Resize", "Concat"
    }  # fmt: skip
    for count in (1, 5):
        x = images(count, seed=4)
        want = output(network, x)
        got = onnx_session(path, optimise=False).run(None, {"image": x})[0]
        assert np.abs(got - want).max() <= np.abs(want).max() / 127.5


def test_a_weights_range_is_the_present_weights(per_channel):
    """Weights that have tripled since the last step are neither clipped nor rounded to an old grid."""
    network = copy.deepcopy(per_channel)
    name, weight = next((n, p) for n, p in network.graph.named_parameters() if p.ndim == 4)
    with torch.no_grad():
        weight.mul_(3)
    shipped = dict(qat.convert(network).named_parameters())[name]
    step = weight.abs().amax(dim=(1, 2, 3), keepdim=True) / 127
    assert bool(((shipped - weight).abs() <= 0.501 * step).all())


def test_tensors_that_meet_in_a_concatenation_share_a_scale(per_channel):
    ranges = {id(q): q for q in per_channel.activation_quantisers()}
    # image, a (= b up-sampled = concatenated), b's input is a: three grids in all
    assert len(ranges) == 2 and len(per_channel.activation_quantisers()) == 5


def test_evaluating_does_not_calibrate(per_channel):
    network = copy.deepcopy(per_channel)
    before = {k: v.clone() for k, v in network.state_dict().items()}
    output(network.eval(), 100 * images())
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
    qat.freeze(network).train()
    output(network, 100 * images())
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items() if k != "frozen")
    network.frozen.fill_(False)
    output(network, 100 * images())
    assert not all(torch.equal(v, before[k]) for k, v in network.state_dict().items())


def test_the_straight_through_estimator_passes_gradients(four_bits):
    network = copy.deepcopy(four_bits).train()
    network(torch.from_numpy(images())).square().mean().backward()
    gradients = {name: p.grad for name, p in network.named_parameters()}
    assert len(gradients) == 6  # weight and bias of three convolutions; nothing is left of the batch norms
    assert all(g is not None and torch.isfinite(g).all() and g.abs().sum() > 0 for g in gradients.values())


def test_training_regains_what_rounding_lost():
    """Weights of three values, one scale per tensor: trained on the float network's answers, the copy comes closer."""
    torch.set_num_threads(1)
    pictures = np.random.default_rng(0).integers(0, 256, (96, 8, 8, 3), dtype=np.uint8)
    scenes = Scenes(pictures, np.zeros((96, 8, 8), np.uint8)).without_labels()
    teacher = trained()
    network = qat.prepare(teacher, torch.zeros(2, *SIZE), weight_bits=2, per_channel=False)
    qat.calibrate(network, scenes.inputs())

    def divergence():
        both = [torch.from_numpy(output(n, scenes.inputs())) for n in (network, teacher)]
        return float(soft_targets_loss(*both, temperature=1.0))

    before = divergence()
    config = FitConfig(epochs=15, batch_size=16, learning_rate=3e-3, flip=False)
    only_teacher = DistilConfig(alpha=1.0, temperature=1.0)
    qat.finetune(network, scenes, config, teacher=teacher, distil=only_teacher, freeze_at=0.5, progress=False)
    assert divergence() < 0.7 * before
    assert bool(network.frozen) and int(network.steps) == 90 and not network.training


def test_bad_input_is_refused(four_bits, tmp_path):
    with pytest.raises(InputError, match="weight_bits"):
        qat.prepare(Tiny(), torch.zeros(2, *SIZE), weight_bits=9)
    with pytest.raises(InputError, match="batch of 2"):
        qat.prepare(Tiny(), torch.zeros(1, *SIZE))
    with pytest.raises(InputError, match="no Conv2d"):
        qat.prepare(nn.ReLU(), torch.zeros(2, 4))
    with pytest.raises(InputError, match=r"torch\.export"):
        qat.prepare(nn.Bilinear(2, 2, 2), torch.zeros(2, 2))
    with pytest.raises(InputError, match="finite"):
        qat.calibrate(four_bits, np.full((1, *SIZE), np.nan, np.float32))
    unseen = qat.prepare(nn.Conv2d(3, 4, 1), torch.zeros(2, *SIZE), activation_bits=4)
    with pytest.raises(InputError, match="seen"):
        qat.convert(unseen)
    with pytest.raises(InputError, match="saturates at 8 bits"):
        qat.export_qat_onnx(qat.calibrate(unseen, images()), tmp_path / "q.onnx", example=(1, *SIZE))
