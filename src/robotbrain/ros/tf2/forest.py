"""Trees of frames: who is whose parent over time, and the walk from one frame to another."""

from __future__ import annotations

from robotbrain.ros.tf2.cache import Sample, StaticCache, TimeCache, seconds
from robotbrain.ros.tf2.exceptions import ConnectivityException, ExtrapolationException, LookupException
from robotbrain.ros.tf2.rotation import IDENTITY, ZERO, Quaternion, Vector, compose, invert

MAX_GRAPH_DEPTH = 1000

Rigid = tuple[Vector, Quaternion]


class Forest:
    """Frames by name, each with its history in its parents.

    Args:
        keep_ns: how far a history reaches back from its newest transform.

    Attributes:
        frames: in order of appearance; None for a frame that is only a parent.
    """

    def __init__(self, keep_ns: int) -> None:
        self.keep_ns = keep_ns
        self.frames: dict[str, TimeCache | StaticCache | None] = {}
        self._authority: dict[str, str] = {}

    def insert(self, child: str, sample: Sample, authority: str, *, static: bool) -> bool:
        """Add a transform; return False when it lies further back than the history."""
        self.frames.setdefault(child, None)
        cache = self.frames[child]
        if cache is None or cache.static != static:
            cache = self.frames[child] = StaticCache() if static else TimeCache(self.keep_ns)
        self.frames.setdefault(sample.parent, None)
        if not cache.insert(sample):
            return False
        self._authority[child] = authority
        return True

    def clear(self) -> None:
        """Forget the history of all moving frames; static transforms stay."""
        for cache in self.frames.values():
            if cache is not None:
                cache.clear()

    def walk(self, target: str, source: str, time_ns: int) -> tuple[Rigid, int]:
        """Return source-to-target and the time it holds for; both frames exist and differ."""
        if time_ns == 0:
            time_ns = self.latest_common_ns(target, source)
        failure: ExtrapolationException | None = None
        rising: Rigid = (ZERO, IDENTITY)  # source to the frame reached so far
        frame = source
        for _ in range(MAX_GRAPH_DEPTH + 1):
            cache = self.frames[frame]
            if cache is None:
                break
            if frame == target:
                return rising, time_ns
            try:
                sample = cache.at(time_ns)
            except ExtrapolationException as error:
                failure = error  # it may yet lie below the common ancestor
                break
            rising = compose((sample.translation, sample.rotation), rising)
            frame = sample.parent
        else:
            raise self._loop()
        top = frame
        falling: Rigid = (ZERO, IDENTITY)
        frame = target
        for _ in range(MAX_GRAPH_DEPTH + 1):
            if frame == top:
                return compose(invert(falling), rising), time_ns
            cache = self.frames[frame]
            if cache is None:
                break
            if frame == source:
                return invert(falling), time_ns
            try:
                sample = cache.at(time_ns)
            except ExtrapolationException as error:
                raise _on_the_way(error, source, target) from None
            falling = compose((sample.translation, sample.rotation), falling)
            frame = sample.parent
        else:
            raise self._loop()
        if failure is not None:
            raise _on_the_way(failure, source, target)
        raise _unconnected(target, source)

    def latest_common_ns(self, target: str, source: str) -> int:
        """Return the earliest among the latest stamps of the moving frames between two frames; 0 when none moves."""
        if source == target:
            cache = self.frames[source]
            return cache.latest()[0] if cache is not None else 0
        climb = self._climb(source, target)
        if climb and climb[-1][1] == target:
            return _earliest(climb)
        ancestors = {parent: index for index, (_, parent) in reversed(list(enumerate(climb)))}
        descent: list[tuple[int, str]] = []
        for step in self._climb(target, source, stop_at=ancestors):
            descent.append(step)
            if step[1] in ancestors:
                return _earliest(descent + climb[: ancestors[step[1]] + 1])
        if descent and descent[-1][1] == source:
            return _earliest(descent)
        raise _unconnected(target, source)

    def _climb(self, start: str, goal: str, stop_at: dict[str, int] | None = None) -> list[tuple[int, str]]:
        """Return (latest stamp, parent) of the frames from ``start`` to its root, ``goal`` or one of ``stop_at``."""
        steps: list[tuple[int, str]] = []
        frame = start
        while (cache := self.frames[frame]) is not None:
            stamp, parent = cache.latest()
            if parent is None:
                break
            steps.append((stamp, parent))
            if parent == goal or (stop_at is not None and parent in stop_at):
                break
            if len(steps) > MAX_GRAPH_DEPTH:
                raise self._loop()
            frame = parent
        return steps

    def as_string(self) -> str:
        """Return one line per frame that has a parent, in order of appearance."""
        return "".join(
            f"Frame {name} exists with parent {cache.latest()[1] or 'NO_PARENT'}.\n"
            for name, cache in self.frames.items()
            if cache is not None
        )

    def as_yaml(self) -> str:
        """Return parent, broadcaster, rate (Hz), times and buffer length (s) of each frame as YAML."""
        if not self.frames:
            return "[]"
        return "".join(self._yaml(name, cache) for name, cache in self.frames.items() if cache is not None)

    def _yaml(self, name: str, cache: TimeCache | StaticCache) -> str:
        parent = cache.latest()[1]
        if parent is None:
            return ""
        oldest, newest = cache.span_ns
        rate = len(cache) * 1e9 / max(newest - oldest, 100_000)
        return (
            f"{name}: \n"
            f"  parent: '{parent}'\n"
            f"  broadcaster: '{self._authority.get(name, 'no recorded authority')}'\n"
            f"  rate: {rate:.3f}\n"
            f"  most_recent_transform: {seconds(newest)}\n"
            f"  oldest_transform: {seconds(oldest)}\n"
            f"  buffer_length: {(newest - oldest) * 1e-9:.3f}\n"
        )

    def _loop(self) -> LookupException:
        return LookupException(f"The tf tree is invalid because it contains a loop.\n{self.as_string()}\n")


def _earliest(steps: list[tuple[int, str]]) -> int:
    return min((stamp for stamp, _ in steps if stamp), default=0)


def _on_the_way(error: ExtrapolationException, source: str, target: str) -> ExtrapolationException:
    return ExtrapolationException(f"{error}, when looking up transform from frame [{source}] to frame [{target}]")


def _unconnected(target: str, source: str) -> ConnectivityException:
    return ConnectivityException(
        f"Could not find a connection between '{target}' and '{source}' because they are not part of the same "
        "tree.Tf has two or more unconnected trees."
    )
