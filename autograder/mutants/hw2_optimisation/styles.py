"""Right solutions of `hw2_optimisation`, written differently: each must earn every point."""

from __future__ import annotations

from robotbrain.grading.sample import Style

_TORCH = {
    "scale": """
def choose_scale(low, high, symmetric=False, bits=8):
    # torch's own arithmetic; the range of zeros is caught at the end.
    ends = torch.tensor([low, high, 0.0], dtype=torch.float64)
    if symmetric:
        scale, zero = ends.abs().max() / (2 ** (bits - 1) - 1), torch.tensor(0)
    else:
        scale = (ends.max() - ends.min()) / (2**bits - 1)
        zero = torch.round(-ends.min() / scale).nan_to_num(0)
    return (scale.item() if scale > 0 else 1.0), int(zero.item())
""",
    "quantise": """
def quantise(x, scale, zero_point, qmin=0, qmax=255):
    x, scale = torch.from_numpy(np.asarray(x, dtype=np.float64)), torch.as_tensor(scale, dtype=torch.float64)
    return torch.clamp(torch.round(x / scale) + zero_point, min=qmin, max=qmax).long().numpy()

def dequantise(q, scale, zero_point):
    return np.float32(scale) * (np.float32(q) - np.float32(zero_point))
""",
    "weights": """
def quantise_weights(weight, per_channel=True):
    w = torch.from_numpy(weight)
    top = w.abs().flatten(1).amax(dim=1).view(-1, *[1] * (w.dim() - 1)) if per_channel else w.abs().max()
    scale = torch.where(top == 0, torch.ones_like(top), top / 127)
    return torch.round(w / scale).clamp(-127, 127).to(torch.int8).numpy(), scale.numpy()
""",
    "range": """
def activation_range(batches, percentile=None):
    x = torch.cat([torch.as_tensor(np.array(b)).flatten() for b in batches]).double()
    if percentile is None:
        return x.min().item(), x.max().item()
    t = torch.quantile(x.abs(), percentile / 100).item()
    return [-t, t]
""",
    "calibrate": """
class Watch:
    def __init__(self, network, names):
        self.network, self.names, self.seen = network, set(names), {n: [] for n in names}

    def __enter__(self):
        self.was = [(m, m.training) for m in self.network.modules()]
        self.handles = []
        for n, m in self.network.named_modules():
            m.training = False
            if n in self.names:
                self.handles.append(m.register_forward_hook(self.note(n)))
        return self.seen

    def note(self, n):
        def hook(module, inputs, output):
            self.seen[n].append(output.detach().clone())
        return hook

    def __exit__(self, *_):
        for h in self.handles:
            h.remove()
        for m, t in self.was:
            m.training = t

def calibrate(network, splits, layers, percentile=None):
    with Watch(network, layers) as seen, torch.inference_mode():
        for k in range(len(splits["calibration"].images)):
            network(torch.from_numpy(splits["calibration"].inputs()[k : k + 1]))
    return {n: activation_range((t.numpy() for t in seen[n]), percentile) for n in layers}
""",
    "mask": """
def magnitude_mask(weight, sparsity):
    n = weight.numel()
    kept = torch.topk(weight.detach().abs().reshape(-1), n - round(sparsity * n)).indices
    return torch.zeros(n, dtype=torch.bool).index_fill(0, kept, True).reshape_as(weight)
""",
    "pattern": """
def two_four_mask(weight):
    o, i, *rest = weight.shape
    groups = weight.abs().reshape(o, i // 4, 4, *rest)
    rank = groups.argsort(dim=2).argsort(dim=2)
    return (rank >= 2).reshape(weight.shape)
""",
    "prune": """
def prune(network, sparsity):
    layers = {n: m for n, m in network.named_modules() if type(m).__name__ in ("Conv2d", "Linear")}
    masks = {n + ".weight": magnitude_mask(m.weight, sparsity) for n, m in layers.items()}
    for n, m in layers.items():
        m.weight.data[~masks[n + ".weight"]] = 0.0
    return masks

def pruned_step(network, masks, optimiser, loss):
    for p in network.parameters():
        p.grad = None
    loss.backward()
    optimiser.step()
    for n, p in network.named_parameters():
        if n in masks:
            p.data = torch.where(masks[n], p.data, torch.zeros(()))
""",
    "loss": """
def distillation_loss(student_logits, teacher_logits, labels, temperature=4.0, alpha=0.7):
    # torch's own kl_div, which wants logarithms first, and averages over what it is told to.
    q = (student_logits / temperature).log_softmax(1)
    p = (teacher_logits.detach() / temperature).softmax(1)
    soft = nn.KLDivLoss(reduction="none")(q, p).sum(1).mean()
    known = labels != 255
    hard = student_logits.sum() * 0
    if known.any():
        hard = nn.CrossEntropyLoss()(student_logits.movedim(1, -1)[known], labels[known])
    return alpha * temperature * temperature * soft + (1 - alpha) * hard
""",
    "step": """
@torch.inference_mode()
def teacher_logits(teacher, images):
    teacher.train(False)
    answers = [teacher(images[k : k + 50]) for k in range(0, len(images), 50)]
    return torch.concatenate(answers).clone()

def distil_step(student, optimiser, images, labels, wanted, temperature=4.0, alpha=0.7):
    student.train()
    optimiser.zero_grad(set_to_none=False)
    loss = distillation_loss(student_logits=student(images), teacher_logits=wanted, labels=labels,
                             temperature=temperature, alpha=alpha)
    loss.backward()
    optimiser.step()
    return float(loss.detach())
""",
    "iou": """
def mean_iou(network, splits):
    was = [m.training for m in network.modules()]
    network.eval()
    hits, unions = torch.zeros(4), torch.zeros(4)
    images, labels = splits["test"].inputs(), torch.from_numpy(splits["test"].labels)
    with torch.inference_mode():
        for k in range(0, len(images), 7):
            said = network(torch.from_numpy(images[k : k + 7])).argmax(1)
            truth = labels[k : k + 7]
            for c in range(4):
                hits[c] += torch.logical_and(said == c, truth == c).sum()
                unions[c] += torch.logical_or(said == c, truth == c).sum()
    for m, t in zip(network.modules(), was):
        m.training = t
    return (hits[unions > 0] / unions[unions > 0]).mean().item()
""",
}

_LOOPS = {
    "scale": """
def choose_scale(low, high, symmetric=False, bits=8):
    if low > 0:
        low = 0.0
    if high < 0:
        high = 0.0
    if symmetric:
        biggest, levels = max(abs(low), abs(high)), 2 ** (bits - 1) - 1
        return (biggest / levels if biggest else 1.0), 0
    levels = 2**bits - 1
    step = (high - low) / levels
    if step == 0:
        return 1.0, 0
    zero = 0
    while abs(low + zero * step) > abs(low + (zero + 1) * step):  # walk up to the level nearest to 0
        zero += 1
    return step, zero
""",
    "quantise": """
def quantise(x, scale, zero_point, qmin=0, qmax=255):
    x = np.asarray(x, dtype=float)
    steps = np.broadcast_to(scale, x.shape)
    q = np.empty(x.shape, dtype=int)
    for place in np.ndindex(x.shape):
        q[place] = min(max(round(float(x[place] / steps[place])) + zero_point, qmin), qmax)
    return q

def dequantise(q, scale, zero_point):
    return np.array((np.array(q, dtype=float) - zero_point) * scale, dtype=np.float32)
""",
    "weights": """
def quantise_weights(weight, per_channel=True):
    if not per_channel:
        scale, _ = choose_scale(float(weight.min()), float(weight.max()), symmetric=True)
        return quantise(weight, scale, 0, qmin=-127, qmax=127).astype("int8"), scale
    rows, scales = [], []
    for channel in weight:
        top = max(float(channel.max()), -float(channel.min()))
        scales.append(top / 127 if top > 0 else 1.0)
        rows.append(quantise(channel, scales[-1], 0, qmin=-127, qmax=127))
    return np.stack(rows).astype("int8"), np.array(scales).reshape(-1, *(1 for _ in weight.shape[1:]))
""",
    "range": """
def activation_range(batches, percentile=None):
    everything = []
    for batch in batches:
        everything.extend(np.asarray(batch).ravel().tolist())
    if percentile is None:
        return min(everything), max(everything)
    sizes = sorted(abs(v) for v in everything)
    t = sizes[int((len(sizes) - 1) * percentile / 100)]
    return -t, t
""",
    "calibrate": """
import copy as _copy

def calibrate(network, splits, layers, percentile=None):
    # A copy is examined, so that there is nothing to put back.
    clone = _copy.deepcopy(network).eval()
    result = {}
    for name in layers:
        kept = []
        dict(clone.named_modules())[name].register_forward_hook(lambda m, i, o, kept=kept: kept.append(o.numpy().copy()))
        with torch.no_grad():
            clone(torch.tensor(splits["calibration"].inputs()))
        result[name] = activation_range(kept, percentile)
    return result
""",
    "mask": """
def magnitude_mask(weight, sparsity):
    sizes = [(abs(v), k) for k, v in enumerate(weight.flatten().tolist())]
    gone = {k for _, k in sorted(sizes)[: round(sparsity * len(sizes))]}
    return torch.tensor([k not in gone for k in range(len(sizes))]).reshape(weight.shape)
""",
    "pattern": """
def two_four_mask(weight):
    mask = torch.ones(weight.shape, dtype=torch.bool)
    flat = weight.reshape(weight.shape[0], weight.shape[1], -1)
    out = mask.view(flat.shape)
    for o in range(flat.shape[0]):
        for k in range(0, flat.shape[1], 4):
            for place in range(flat.shape[2]):
                four = [(abs(float(flat[o, k + j, place])), j) for j in range(4)]
                for _, j in sorted(four)[:2]:
                    out[o, k + j, place] = False
    return mask
""",
    "loss": """
def distillation_loss(student_logits, teacher_logits, labels, temperature=4.0, alpha=0.7):
    # Pixels in rows, classes in columns; the rest by the book.
    z = student_logits.movedim(1, -1).reshape(-1, student_logits.shape[1])
    v = teacher_logits.movedim(1, -1).reshape(-1, teacher_logits.shape[1]).detach()
    p, q = torch.softmax(v / temperature, 1), torch.softmax(z / temperature, 1)
    soft = (p * torch.log(p / q)).sum() / len(z)
    total = alpha * temperature**2 * soft
    y = labels.reshape(-1)
    if bool((y != 255).sum()):
        rows = torch.arange(len(y))[y != 255]
        total = total - (1 - alpha) * torch.log_softmax(z, 1)[rows, y[rows]].mean()
    return total
""",
    "iou": """
def mean_iou(network, splits):
    counts = np.zeros((4, 4))
    mode = network.training
    network.eval()
    for image, truth in zip(splits["test"].inputs(), splits["test"].labels):
        with torch.no_grad():
            said = network(torch.from_numpy(image[None]))[0].argmax(dim=0).numpy()
        for t, s in zip(truth.ravel(), said.ravel()):
            counts[t, s] += 1
    network.train(mode)
    values = []
    for c in range(4):
        union = counts[c].sum() + counts[:, c].sum() - counts[c, c]
        if union:
            values.append(counts[c, c] / union)
    return sum(values) / len(values)
""",
    "readings": """
import onnx

def readings(path, iou, teacher_iou, budget):
    kinds = [node.op_type for node in onnx.load(str(path)).graph.node]
    precision = "int8" if kinds.count("DequantizeLinear") else "fp16"
    with open(path, "rb") as file:
        size = len(file.read())
    result = predict(str(path), budget["module"], precision=precision, mode=budget["mode"], batch=budget["cameras"])
    return dict(drop=-(iou - teacher_iou), latency_ms=result.fixed_ms + sum(k.total_ms for k in result.kernels),
                bytes=size)
""",
}

_NUMPY = {
    "scale": """
def choose_scale(low, high, symmetric=False, bits=8):
    low, high = np.minimum(low, 0), np.maximum(high, 0)
    top, steps = (np.maximum(-low, high), 2 ** (bits - 1) - 1) if symmetric else (high - low, 2**bits - 1)
    scale = np.where(top > 0, top / steps, 1.0)
    return scale[()], np.int64(0) if symmetric else np.rint(-low / scale).astype(np.int64)
""",
    "quantise": """
def quantise(x, scale, zero_point, qmin=0, qmax=255):
    # Half up instead of half to even: as near.
    steps = np.floor(np.divide(x, scale, dtype=np.float64) + 0.5).astype(np.int64) + zero_point
    return np.minimum(np.maximum(steps, qmin), qmax)

def dequantise(q, scale, zero_point):
    return np.multiply(np.subtract(q, zero_point, dtype=np.float64), scale).astype("f4")
""",
    "range": """
def activation_range(batches, percentile=None):
    low, high, sizes = np.inf, -np.inf, [np.zeros(0)]
    for batch in batches:
        low, high = np.minimum(low, batch.min()), np.maximum(high, batch.max())
        if percentile is not None:
            sizes.append(np.abs(batch).ravel())
    if percentile is None:
        return np.array([low, high])
    t = np.percentile(np.concatenate(sizes), percentile, method="higher")
    return np.array([-t, t])
""",
    "mask": """
def magnitude_mask(weight, sparsity):
    sizes = np.abs(weight.detach().numpy()).ravel()
    mask = np.ones(sizes.size, dtype=bool)
    drop = int(round(sparsity * sizes.size))
    if drop:
        mask[np.argpartition(sizes, drop - 1)[:drop]] = False
    return torch.from_numpy(mask.reshape(tuple(weight.shape)))
""",
    "prune": """
def prune(network, sparsity):
    chosen = []
    for name, layer in network.named_modules():
        if isinstance(layer, nn.Conv2d) or isinstance(layer, nn.Linear):
            chosen.append((name + ".weight", layer))
    masks = {}
    for name, layer in chosen:
        masks[name] = magnitude_mask(layer.weight.detach(), sparsity)
        with torch.no_grad():
            layer.weight.copy_(layer.weight * masks[name].float())
    return masks

def pruned_step(network, masks, optimiser, loss):
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    for name, mask in masks.items():
        network.get_parameter(name).grad *= mask  # not needed, and does no harm
    optimiser.step()
    with torch.no_grad():
        for name, mask in masks.items():
            network.get_parameter(name).masked_fill_(~mask, 0.0)
""",
    "loss": """
def distillation_loss(student_logits, teacher_logits, labels, temperature=4.0, alpha=0.7):
    # KL is cross entropy minus entropy; torch's cross_entropy takes probabilities as targets.
    with torch.no_grad():
        p = torch.softmax(teacher_logits / temperature, dim=1)
        entropy = torch.special.entr(p).sum(dim=1).mean()
    soft = F.cross_entropy(student_logits / temperature, p) - entropy
    hard = F.cross_entropy(student_logits, labels, ignore_index=255, reduction="sum")
    return alpha * temperature**2 * soft + (1 - alpha) * hard / max(1, int((labels != 255).sum()))
""",
    "iou": """
def mean_iou(network, splits):
    scenes, mode = splits["test"], network.training
    network.eval()
    try:
        with torch.no_grad():
            logits = np.concatenate([network(part).numpy() for part in torch.from_numpy(scenes.inputs()).split(50)])
    finally:
        network.train(mode)
    index = 4 * scenes.labels.astype(int) + logits.argmax(axis=1)
    table = np.bincount(index.ravel(), minlength=16).reshape(4, 4)
    inside = table.diagonal()
    union = table.sum(0) + table.sum(1) - inside
    return np.mean(inside[union > 0] / union[union > 0])
""",
}

STYLES = [
    Style("torch-only", _TORCH, "everything in torch: quantiles, ranks, a context manager for hooks"),
    Style("loops", _LOOPS, "lists, sorting and loops; a copy of the network is examined"),
    Style("numpy", _NUMPY, "NumPy wherever it goes: one pass, partitions, entropies"),
]
