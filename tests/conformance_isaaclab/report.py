"""Results of the checks, as one table."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Report:
    """What was compared, what differed, and what was not compared and why."""

    rows: list[tuple[str, str, int, int, str]] = field(default_factory=list)
    uncovered: list[tuple[str, str]] = field(default_factory=list)
    _open: dict[tuple[str, str], list[int | str]] = field(default_factory=dict)

    def check(self, part: str, what: str, same: bool, detail: str = "") -> None:
        """One comparison; ``detail`` is kept of the first that fails."""
        row = self._open.setdefault((part, what), [0, 0, ""])
        row[0] = int(row[0]) + 1
        if not same:
            row[1] = int(row[1]) + 1
            row[2] = row[2] or detail

    def skip(self, what: str, why: str) -> None:
        """Something that could not be compared."""
        self.uncovered.append((what, why))

    @property
    def failures(self) -> int:
        """Comparisons that differed."""
        return sum(int(row[1]) for row in self._open.values())

    def __str__(self) -> str:
        lines = [f"{'part':<12} {'compared':<44} {'checks':>7} {'differ':>7}", "-" * 74]
        for (part, what), (count, wrong, detail) in self._open.items():
            lines.append(f"{part:<12} {what:<44} {count:>7} {wrong:>7}" + (f"  {detail}" if wrong else ""))
        total = sum(int(row[0]) for row in self._open.values())
        lines += ["-" * 74, f"{'':<12} {'together':<44} {total:>7} {self.failures:>7}"]
        if self.uncovered:
            lines += ["", "Not covered:"] + [f"  {what}: {why}" for what, why in self.uncovered]
        return "\n".join(lines)
