"""``robotbrain rl list``: the tasks, and what one is made of."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from robotbrain.rl.recipes import check_task, default_algorithm
from robotbrain.rl.registry import TASKS, make, task_cfg


def list_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain rl list``."""
    parser.add_argument("task", nargs="?", help="show the terms of this task")


def list_main(arguments: argparse.Namespace) -> int:
    """Print the tasks, or one task's terms."""
    if arguments.task is None:
        rows: list[tuple[str, ...]] = [
            ("task", "observations", "actions", "environments", "episode", "control", "trained with")
        ]
        rows += [_row(name) for name in TASKS]
        print(_aligned(rows))
        print("\nrobotbrain rl list TASK shows its terms; robotbrain rl train TASK trains it.")
    else:
        check_task(arguments.task)
        print(_terms(arguments.task))
    return 0


def _row(name: str) -> tuple[str, ...]:
    env = make(name, num_envs=1, seed=0)
    return (
        name,
        str(_size(env.observation_manager.group_obs_dim["policy"])),
        str(env.action_manager.total_action_dim),
        str(task_cfg(name).scene.num_envs),
        f"{env.max_episode_length * env.step_dt:g} s",
        f"{1 / env.step_dt:g} Hz",
        default_algorithm(name),
    )


def _terms(name: str) -> str:
    env: Any = make(name, num_envs=1, seed=0)
    seen, rewards = env.observation_manager, env.reward_manager
    lines: list[str] = []
    for group, terms in seen.active_terms.items():
        lines.append(f"observations, group {group!r}: {_size(seen.group_obs_dim[group])} numbers")
        sizes = seen.group_obs_term_dim[group]
        lines += _indented([(term, str(_size(size))) for term, size in zip(terms, sizes, strict=True)])
    lines.append(f"actions: {env.action_manager.total_action_dim} numbers")
    acts = env.action_manager
    lines += _indented([(term, str(acts.get_term(term).action_dim)) for term in acts.active_terms])
    lines.append("rewards, weight per second")
    lines += _indented([(term, f"{rewards.get_term_cfg(term).weight:g}") for term in rewards.active_terms])
    ends = env.termination_manager
    lines.append("terminations")
    lines += _indented(
        [(term, "time is up" if ends.get_term_cfg(term).time_out else "the task ends") for term in ends.active_terms]
    )
    if env.command_manager.active_terms:
        lines += ["commands", *_indented([(term, "") for term in env.command_manager.active_terms])]
    events = [(term, mode) for mode, terms in env.event_manager.active_terms.items() for term in terms]
    if events:
        lines += ["events", *_indented(events)]
    return "\n".join([f"{name}: {TASKS[name].partition(':')[0]}", *lines])


def _size(shape: Any) -> int:
    size = 1
    for part in shape if isinstance(shape, tuple | list) else (shape,):
        size *= int(part)
    return size


def _indented(rows: Sequence[tuple[str, str]]) -> list[str]:
    return ["    " + line for line in _aligned(rows).splitlines()]


def _aligned(rows: Sequence[tuple[str, ...]]) -> str:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join("  ".join(f"{cell:{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows)
