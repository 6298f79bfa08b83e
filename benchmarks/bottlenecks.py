"""Does the bottleneck report name what is wrong, and do its predictions come true?

Generated pipelines with a planted bottleneck are diagnosed; its best proposal and the cure are then really made. Seeds
0 to 199 and 2000 to 2007 were used while the rules were written; report on others. With --brain the kit's own brain on
three Jetsons: each option of its deployment is predicted and then driven.

Usage: python benchmarks/bottlenecks.py [--first 1000] [--count 20] [--seconds 20] [--brain]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from robotbrain.monitoring.diagnosis import diagnose
from robotbrain.monitoring.diagnosis_options import brain_options
from robotbrain.monitoring.generate import generate_pipeline
from robotbrain.monitoring.whatif import Change, Device, Faster, OwnExecutor, Prediction, WhatIf, outcome

BRAINS = ("nano-4gb:5W", "xavier-nx:15W", "orin-nano-8gb:15W")


@dataclass(frozen=True)
class Case:
    """One generated pipeline.

    Attributes:
        seed, fault, culprit: what was planted.
        named: what the report says.
        right: whether that is it.
        best: its first proposal.
        best_error, cure_error: of the predicted gain in the median, relative to the gain when it is made.
        day_error: the same for the cure when it is made on another day, with other work times.
    """

    seed: int
    fault: str
    culprit: str
    named: str
    right: bool
    best: str
    gain: float
    best_error: float
    cure_error: float
    day_error: float


def error(prediction: Prediction, real_p50_ms: float) -> float:
    """Return the error of a predicted gain, relative to the gain made."""
    made = prediction.before.p50_ms - real_p50_ms
    return abs(prediction.gain_ms - made) / abs(made) if made else float("inf")


def examine(seed: int, seconds: float) -> Case:
    """Diagnose one generated pipeline and make its best proposal and its cure."""
    pipeline = generate_pipeline(seed)
    trace = pipeline.run(seconds)
    found = diagnose(trace, options=pipeline.options)
    top, source = found.bottleneck, found.before.source
    cure = next(p for p in (*found.proposals, *found.useless) if p.change == pipeline.cure)
    best = found.best or cure

    def made(change: Change, day: int = 0) -> float:
        return outcome(pipeline.changed(change).run(seconds, day=day), source=source).p50_ms

    return Case(
        seed,
        pipeline.fault,
        pipeline.culprit,
        top.name,
        top.kind == pipeline.fault and (not pipeline.culprit or top.culprit == pipeline.culprit),
        str(best.change),
        cure.gain,
        error(best, made(best.change)),
        error(cure, made(pipeline.cure)),
        error(cure, made(pipeline.cure, day=1)),
    )


def report(cases: Sequence[Case]) -> None:
    """Print every case and the summary."""
    for case in cases:
        mark = "right" if case.right else "WRONG"
        print(
            f"{case.seed:6} {mark}  planted {case.fault} {case.culprit}; named {case.named}; cure {case.gain:.0%}, "
            f"error {case.cure_error:.1%} (another day {case.day_error:.1%}); "
            f"best: {case.best}, error {case.best_error:.1%}"
        )
    print(f"\nnamed the planted bottleneck: {sum(case.right for case in cases)} of {len(cases)}")
    for label, values in (
        ("best proposal", [case.best_error for case in cases]),
        ("cure", [case.cure_error for case in cases]),
        ("cure, another day", [case.day_error for case in cases]),
    ):
        within = sum(value <= 0.1 for value in values)
        print(
            f"error of the predicted gain, {label}: median {np.median(values):.2%}, largest {max(values):.1%}, "
            f"within 10 %: {within} of {len(values)}"
        )


def brains(world: int) -> None:
    """Predict each option of the kit's brain on three Jetsons, then drive it."""
    from robotbrain.pipeline.brain import drive
    from robotbrain.pipeline.devices import detector_deployment

    for name in BRAINS:
        deployment = detector_deployment(one_thread=True)
        run = drive(world, profile=name, deployment=deployment, trace=True, time_limit=30)
        assert run.trace is not None
        study = WhatIf(run.trace)
        for option in brain_options(name, deployment):
            changed, device = deployment, name
            if isinstance(option, OwnExecutor):
                changed = replace(deployment, one_thread=False)
            elif isinstance(option, Faster):
                changed = replace(deployment, precision="int8")
            elif isinstance(option, Device):
                device = f"{name.partition(':')[0]}:{option.name.rpartition(' ')[2]}"
            else:
                changed = replace(deployment, image_size=(320, 240))
            made = drive(world, profile=device, deployment=changed, trace=True, time_limit=30)
            assert made.trace is not None
            prediction, real, wrong = study.check(option, made.trace)
            print(
                f"{name:18} {str(option)[:52]:52} median {prediction.before.p50_ms:6.1f} -> predicted "
                f"{prediction.after.p50_ms:6.1f}, driven {real.p50_ms:6.1f} ms, error of the gain {wrong:.1%}"
            )


def main() -> None:
    """Print the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=1000, help="first seed")
    parser.add_argument("--count", type=int, default=20, help="pipelines")
    parser.add_argument("--seconds", type=float, default=20.0, help="simulated, of each run")
    parser.add_argument("--brain", action="store_true", help="the kit's brain too")
    parser.add_argument("--world", type=int, default=6000, help="world that the brain drives in")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.count)
    report([examine(s, arguments.seconds) for s in tqdm(seeds, unit="pipeline", file=sys.stderr, disable=None)])
    if arguments.brain:
        print()
        brains(arguments.world)


if __name__ == "__main__":
    main()
