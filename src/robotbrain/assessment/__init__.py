"""The assessment: papers drawn per student from a bank of questions, and their marking.

The bank with its key lies in ``autograder/assessment`` and never ships. What ships is how a paper looks
(:mod:`~robotbrain.assessment.paper`), how a bank is read, drawn from and marked against, and a small practice bank
whose key is public.
"""

from robotbrain.assessment.paper import Item, Paper

__all__ = ["Item", "Paper", "open_paper", "review", "show"]


def open_paper(path: str = "paper.json") -> Paper:
    """The paper in the file beside the notebook; where there is none, the practice paper."""
    from robotbrain.assessment.records import open_paper as opened

    return opened(path)


def show(paper: Paper, name: str) -> None:
    """Display one question of a paper, with a form that writes the line to type; see :mod:`.show`."""
    from robotbrain.assessment.show import show as shown

    shown(paper, name)


def review(paper: Paper, namespace: dict[str, object]) -> object:
    """What was answered so far, as a table; of a practice paper with reasons; see :mod:`.show`."""
    from robotbrain.assessment.show import review as reviewed

    return reviewed(paper, namespace)
