"""The prose of the course can be read: by people in their second language, in a hurry, or who listen to it."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path

import pytest

from tests import prose

REPO = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted(
    path
    for folder in ("course", "solutions")
    for path in (REPO / folder).rglob("*.ipynb")
    if ".ipynb_checkpoints" not in path.parts
)
PAGES = sorted({*REPO.glob("*.md"), *(REPO / "autograder").rglob("*.md"), *(REPO / "course").glob("*.md")})
NOT_READ_FROM_TOP_TO_BOTTOM = {"OUTLINE.md"}  # made from course/outline.toml: tables, and what others wrote

GRADE, MEAN = 9.0, 19.0  # school year, words: what a newspaper for everybody keeps
GRADE_OF_PAGES, MEAN_OF_PAGES, LONGEST_OF_PAGES = 15.0, 27.0, 60  # reference for instructors: dense, but no denser

EVERYDAY = {
    *(
        "CPU",
        "CPUs",
        "GB",
        "GPU",
        "GPUs",
        "HTML",
        "JSON",
        "MB",
        "PC",
        "PDF",
        "PNG",
        "RGB",
        "SD",
        "SDK",
        "SHA",
        "SI",
        "USB",
    ),
    *("AGX", "CUDA", "NVIDIA", "NX", "RTX", "TX2", "YOLO11n", "YOLO11s"),
}
"""Everyday words, units, and names of products."""

GLOSSARY = {
    "ROS": "Robot Operating System",
    "REP": "ROS Enhancement Proposal",
    "QoS": "quality of service",
    "FP16": "16 bits",
    "FP32": "32 bits",
    "INT8": "8 bits",
    "TF32": "10 bits of mantissa",
    "SM": "streaming multiprocessors",
    "DLA": "deep-learning accelerators",
    "LPDDR": "low-power",
    "MAC": "multiply-accumulate",
    "FLOP": "floating-point operation",
    "FLOPS": "floating-point operation",
    "TOPS": "operations",
    "EMC": "memory",
    "MiB": "bytes",
    "GiB": "bytes",
    "ONNX": "Open Neural Network Exchange",
    "DQ": "DequantizeLinear",
    "ReLU": "rectified linear unit",
    "NaN": "not a number",
    "PPO": "proximal policy optimisation",
    "DDPG": "deep deterministic policy gradient",
    "TD3": "twin delayed",
    "SAC": "soft actor-critic",
    "MJCF": "robot's description",
    "URDF": "robot's description",
    "PTP": "precision time protocol",
    "VNNI": "instructions",
    "QAT": "quantisation-aware training",
    "IoU": "intersection over union",
    "KL": "Kullback",
    "NVML": "management library",
    "PSI": "population stability index",
    "CE": "cross entropy",
}
"""Abbreviations of the lessons with words that explain them, which stand where the first lesson that uses one does."""

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
every_text = pytest.mark.parametrize("path", [*NOTEBOOKS, *PAGES], ids=lambda p: p.relative_to(REPO).as_posix())


def whole(path: Path) -> str:
    return "\n\n".join(passage.text for passage in prose.passages(path))


@every_text
def test_sentences_are_short_enough(path: Path) -> None:
    if path.name in NOT_READ_FROM_TOP_TO_BOTTOM:
        return
    text = whole(path)
    longest = prose.LONGEST if path in NOTEBOOKS else LONGEST_OF_PAGES
    long = [s for s in prose.sentences(text) if len(s.split()) > longest]
    assert not long, "\n".join(long)
    grade, mean = (GRADE, MEAN) if path in NOTEBOOKS else (GRADE_OF_PAGES, MEAN_OF_PAGES)
    assert prose.readability(text) <= grade and prose.mean_length(text) <= mean


@every_text
def test_nobody_is_talked_down_to_or_left_out(path: Path) -> None:
    listed = prose.TALKS_DOWN + prose.LATIN_AND_IDIOM + prose.PERSONS + prose.UNKIND
    found = [f"{p.place}: {word}" for p in prose.passages(path) for word in prose.words_found(p.text, listed)]
    assert not found, "\n".join(found)


@every_text
def test_spelling_is_british(path: Path) -> None:
    if path.name in NOT_READ_FROM_TOP_TO_BOTTOM:
        return
    found = [f"{p.place}: {word}" for p in prose.passages(path) for word in prose.words_found(p.text, prose.AMERICAN)]
    assert not found, "\n".join(found)


@every_text
def test_links_say_where_they_lead(path: Path) -> None:
    for words in re.findall(r"(?<!!)\[([^\]]*)\]\(", whole(path)):
        assert words.strip(" .`*").lower() not in prose.EMPTY_LINKS and (len(words) > 1 or words.isdigit()), words


@every_text
def test_headings_make_an_outline_and_tables_have_heads(path: Path) -> None:
    text = whole(path)
    levels = [level for level, _ in prose.headings(text)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels)), prose.headings(text)
    assert prose.tables_without_head(text) == []


def abbreviations(text: str) -> list[str]:
    """Return abbreviations in the order of their first use, without a plural's s, or what multiplies a unit."""
    found = re.findall(r"(?<![\w`])[A-Z][A-Za-z]?[A-Z]+[0-9]*s?(?!\w)", prose.plain(text))
    found = [re.sub(r"^[GTMP](?=FLOP)", "", word) for word in found]
    return list(
        dict.fromkeys(word if word in EVERYDAY or word == "FLOPS" else word.removesuffix("s") for word in found)
    )


def test_abbreviations_are_explained_where_they_come_up_first() -> None:
    """In or before the second cell after it at the latest: some are shown at work before they are named."""
    known: set[str] = set()
    trouble = []
    for path in sorted((REPO / "course").glob("[01][0-9]_*.ipynb"))[1:]:
        cells = prose.passages(path)
        for number, passage in enumerate(cells):
            so_far = " ".join(" ".join(p.text for p in cells[: number + 3]).lower().split())
            for word in abbreviations(passage.text):
                if word in EVERYDAY or word in known or re.fullmatch(r"[A-Z]\d?", word):
                    continue
                known.add(word)
                if word not in GLOSSARY or GLOSSARY[word].lower() not in so_far:
                    trouble.append(f"{passage.place}: {word}")
    assert not trouble, "\n".join(trouble)


def test_labs_use_no_abbreviation_that_is_not_in_the_glossary() -> None:
    for path in NOTEBOOKS:
        unknown = [w for w in abbreviations(whole(path)) if w not in EVERYDAY and w not in GLOSSARY]
        assert not [w for w in unknown if not re.fullmatch(r"[A-Z]\d?", w)], (path.name, unknown)


# ---------------------------------------------------------------- the rules themselves


@pytest.mark.parametrize(
    ("text", "patterns"),
    [
        ("You can simply run it.", prose.TALKS_DOWN),
        ("Of course it works.", prose.TALKS_DOWN),
        ("Then just run the cell.", prose.TALKS_DOWN),
        ("Use a sensor, e.g. a camera.", prose.LATIN_AND_IDIOM),
        ("It goes via the bus.", prose.LATIN_AND_IDIOM),
        ("Ask the operator what he saw.", prose.PERSONS),
        ("Do a sanity check.", prose.UNKIND),
        ("The color of the box.", prose.AMERICAN),
        ("We optimized the two meters of it.", prose.AMERICAN),
        ("Its behavior is labeled.", prose.AMERICAN),
    ],
)
def test_a_stumbling_block_is_found(text: str, patterns: tuple[str, ...]) -> None:
    assert prose.words_found(text, patterns)


@pytest.mark.parametrize(
    "text",
    [
        "A parameter in metres, optimised; colours of neighbours; its size and behaviour.",
        "`color` is a keyword, and [x](https://color.example) a link.",
        "It has just stopped. An easy world. The centre, aviation, previa.",
        "> the outline says that it simply works",
        "```\njust run color\n```",
    ],
)
def test_what_is_fine_is_left_alone(text: str) -> None:
    listed = prose.TALKS_DOWN + prose.LATIN_AND_IDIOM + prose.PERSONS + prose.UNKIND + prose.AMERICAN
    assert prose.words_found(text, listed) == []


def test_readability_grows_with_words_and_sentences() -> None:
    easy = "The robot sees a box. It stops. Then it turns and goes on."
    hard = "Subsequently, environmental perception infrastructure necessitates comprehensive reconfiguration thereof."
    assert prose.readability(easy) < 3 < 15 < prose.readability(hard)
    assert prose.mean_length(easy) == pytest.approx(13 / 3)


def test_headings_and_tables_are_read() -> None:
    text = "# A\n\n```\n# no\n```\n\n### B\n\n| a | b |\n| - | - |\n| 1 | 2 |\n\n| 3 | 4 |\n| 5 | 6 |\n"
    assert prose.headings(text) == [(1, "A"), (3, "B")]
    assert prose.tables_without_head(text) == ["| 3 | 4 |"]


def test_a_notebook_is_read_cell_by_cell(tmp_path: Path) -> None:
    cells = [
        {"id": "a", "cell_type": "markdown", "source": ["# T\n", "x"]},
        {"id": "b", "cell_type": "code", "source": []},
    ]
    (path := tmp_path / "n.ipynb").write_text(json.dumps({"cells": cells}), encoding="utf-8")
    assert prose.passages(path) == [prose.Passage("n.ipynb#a", "# T\nx")]
