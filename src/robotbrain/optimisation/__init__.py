"""Making networks smaller and faster, and proving it: quantisation, pruning, distillation, export, comparison.

The names here are loaded when first used, so that importing the package stays cheap: ``torch`` and ONNX Runtime only
come with the function that needs them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy

if TYPE_CHECKING:
    from robotbrain.optimisation.affine import (
        QParams,
        choose_qparams,
        dequantize,
        fake_quantize,
        per_channel_range,
        per_tensor_range,
        quantize,
    )
    from robotbrain.optimisation.calibration import (
        CalibrationTable,
        EntropyObserver,
        MinMaxObserver,
        PercentileObserver,
        calibrate,
    )
    from robotbrain.optimisation.data import Scenes, scenes, scenes_of
    from robotbrain.optimisation.distillation import DistilConfig, FeatureLoss, distillation_loss, soft_targets_loss
    from robotbrain.optimisation.evaluate import IoUResult, mean_iou, onnx_session
    from robotbrain.optimisation.export import export_onnx
    from robotbrain.optimisation.latency import HostLatency, host_latency
    from robotbrain.optimisation.networks import (
        build_depthwise,
        build_student,
        build_teacher,
        load_network,
        network_path,
        provenance,
    )
    from robotbrain.optimisation.pareto import pareto_front
    from robotbrain.optimisation.pruning import (
        GradualPruning,
        MaskedPruning,
        cubic_sparsity,
        l1_mask,
        l1_masks,
        sparsity_of,
    )
    from robotbrain.optimisation.ptq import QuantisedModel, quantise_onnx
    from robotbrain.optimisation.qdq_lint import Finding, check, lint
    from robotbrain.optimisation.recipe import Artefact, Budget, Recipe
    from robotbrain.optimisation.semi_structured import is_two_four, two_four_mask, two_four_masks
    from robotbrain.optimisation.structured import fit_to_state, prune_channels
    from robotbrain.optimisation.sweep import Sweep, default_recipes, load_rows
    from robotbrain.optimisation.sweep_plots import plot_sweep
    from robotbrain.optimisation.training import FitConfig, FitResult, fit
    from robotbrain.optimisation.workshop import Workshop

_MODULE_OF = {
    "QParams": "affine",
    "choose_qparams": "affine",
    "dequantize": "affine",
    "fake_quantize": "affine",
    "per_channel_range": "affine",
    "per_tensor_range": "affine",
    "quantize": "affine",
    "CalibrationTable": "calibration",
    "EntropyObserver": "calibration",
    "MinMaxObserver": "calibration",
    "PercentileObserver": "calibration",
    "calibrate": "calibration",
    "Scenes": "data",
    "scenes": "data",
    "scenes_of": "data",
    "DistilConfig": "distillation",
    "FeatureLoss": "distillation",
    "distillation_loss": "distillation",
    "soft_targets_loss": "distillation",
    "IoUResult": "evaluate",
    "mean_iou": "evaluate",
    "onnx_session": "evaluate",
    "export_onnx": "export",
    "HostLatency": "latency",
    "host_latency": "latency",
    "build_depthwise": "networks",
    "build_student": "networks",
    "build_teacher": "networks",
    "load_network": "networks",
    "network_path": "networks",
    "provenance": "networks",
    "pareto_front": "pareto",
    "GradualPruning": "pruning",
    "MaskedPruning": "pruning",
    "cubic_sparsity": "pruning",
    "l1_mask": "pruning",
    "l1_masks": "pruning",
    "sparsity_of": "pruning",
    "QuantisedModel": "ptq",
    "quantise_onnx": "ptq",
    "Finding": "qdq_lint",
    "check": "qdq_lint",
    "lint": "qdq_lint",
    "Artefact": "recipe",
    "Budget": "recipe",
    "Recipe": "recipe",
    "is_two_four": "semi_structured",
    "two_four_mask": "semi_structured",
    "two_four_masks": "semi_structured",
    "fit_to_state": "structured",
    "prune_channels": "structured",
    "Sweep": "sweep",
    "default_recipes": "sweep",
    "load_rows": "sweep",
    "plot_sweep": "sweep_plots",
    "FitConfig": "training",
    "FitResult": "training",
    "fit": "training",
    "Workshop": "workshop",
}

__all__ = [
    "Artefact",
    "Budget",
    "CalibrationTable",
    "DistilConfig",
    "EntropyObserver",
    "FeatureLoss",
    "Finding",
    "FitConfig",
    "FitResult",
    "GradualPruning",
    "HostLatency",
    "IoUResult",
    "MaskedPruning",
    "MinMaxObserver",
    "PercentileObserver",
    "QParams",
    "QuantisedModel",
    "Recipe",
    "Scenes",
    "Sweep",
    "Workshop",
    "build_depthwise",
    "build_student",
    "build_teacher",
    "calibrate",
    "check",
    "choose_qparams",
    "cubic_sparsity",
    "default_recipes",
    "dequantize",
    "distillation_loss",
    "export_onnx",
    "fake_quantize",
    "fit",
    "fit_to_state",
    "host_latency",
    "is_two_four",
    "l1_mask",
    "l1_masks",
    "lint",
    "load_network",
    "load_rows",
    "mean_iou",
    "network_path",
    "onnx_session",
    "pareto_front",
    "per_channel_range",
    "per_tensor_range",
    "plot_sweep",
    "provenance",
    "prune_channels",
    "quantise_onnx",
    "quantize",
    "scenes",
    "scenes_of",
    "soft_targets_loss",
    "sparsity_of",
    "two_four_mask",
    "two_four_masks",
]
__getattr__, __dir__ = lazy(__name__, _MODULE_OF, globals())
