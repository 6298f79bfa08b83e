"""Runs notebook cells in this process, without a kernel: IPython, and outputs as plain messages.

The messages are those of :class:`~robotbrain.grading.sandbox.process.Cells`: ``stream``, ``output``, ``clear``.
"""

from __future__ import annotations

import ast
import base64
import builtins
import contextlib
import io
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any

from IPython.core.displayhook import DisplayHook
from IPython.core.displaypub import DisplayPublisher
from IPython.core.history import HistoryManager
from IPython.core.inputtransformer2 import TransformerManager
from IPython.core.interactiveshell import InteractiveShell
from traitlets import Instance, Type

Send = Callable[[dict[str, Any]], None]

_PIECE = 8192  # characters of a stream that are sent together
_SOON_S = 0.2  # a stream's text is sent at least this often while there is more
_MESSAGE_OVERHEAD = 64


class Outlet:
    """Where outputs go: to ``send``, up to a number of bytes per cell, or nowhere."""

    def __init__(self) -> None:
        self.send: Send | None = None
        self.budget = 0
        self._left = 0
        self._told = False

    def begin(self) -> None:
        """A cell begins: its whole budget is there again."""
        self._left, self._told = self.budget, False

    def put(self, message: dict[str, Any], size: int) -> None:
        """Send an output of ``size`` bytes, or note once that there was too much."""
        if self.send is None:
            return
        if size + _MESSAGE_OVERHEAD <= self._left:
            self._left -= size + _MESSAGE_OVERHEAD
            self.send(message)
        elif not self._told:
            self._told = True
            text = f"Output beyond {self.budget} bytes was dropped.\n"
            self.send({"op": "stream", "name": "stdout", "text": text})

    def final(self, message: dict[str, Any], size: int) -> None:
        """Send what must be known after a flood too, such as why the cell failed."""
        if self.send is not None and size <= self.budget:
            self.send(message)


OUTLET = Outlet()
_running = False


class Stream(io.TextIOBase):
    """``sys.stdout`` or ``sys.stderr`` of the notebook."""

    encoding = "utf-8"
    errors = "backslashreplace"

    def __init__(self, name: str, number: int) -> None:
        self.name, self._number = name, number
        self._pieces: list[str] = []
        self._length, self._since = 0, 0.0

    def writable(self) -> bool:
        """True."""
        return True

    def isatty(self) -> bool:
        """False."""
        return False

    def fileno(self) -> int:
        """The descriptor of this stream, behind which nothing is kept."""
        return self._number

    def write(self, text: str) -> int:
        """Take ``text``; it is sent in pieces."""
        if not isinstance(text, str):
            raise TypeError(f"write() argument must be str, not {type(text).__name__}")
        now = time.monotonic()
        if not self._pieces:
            self._since = now
        self._pieces.append(text)
        self._length += len(text)
        if self._length >= _PIECE or now - self._since > _SOON_S:
            self.flush()
        return len(text)

    def flush(self) -> None:
        """Send what was written."""
        pieces, self._pieces, self._length = self._pieces, [], 0
        text = "".join(pieces)
        for start in range(0, len(text), _PIECE):
            piece = text[start : start + _PIECE].encode("utf-8", "backslashreplace").decode()
            OUTLET.put({"op": "stream", "name": self.name, "text": piece}, len(piece))


class _Display(DisplayPublisher):  # type: ignore[misc]
    """Rich output (``display``, plots)."""

    def publish(
        self,
        data: Mapping[str, Any],
        metadata: Mapping[str, Any] | None = None,
        source: object = None,
        *,
        transient: Mapping[str, Any] | None = None,
        update: bool = False,
        **_: object,
    ) -> None:
        _flush()
        name = (transient or {}).get("display_id")
        plain = _plain(data)
        output = {"output_type": "display_data", "data": plain}
        message = {"op": "output", "output": output, "id": name if isinstance(name, str) else None, "update": update}
        OUTLET.put(message, _size(plain))

    def clear_output(self, wait: bool = False) -> None:
        _flush()
        OUTLET.put({"op": "clear", "wait": bool(wait)}, 0)


class _Result(DisplayHook):  # type: ignore[misc]
    """The value of a cell's last expression."""

    def write_output_prompt(self) -> None:
        pass

    def write_format_data(self, format_dict: Mapping[str, Any], md_dict: Mapping[str, Any] | None = None) -> None:
        _flush()
        plain = _plain(format_dict)
        output = {"output_type": "execute_result", "data": plain}
        OUTLET.put({"op": "output", "output": output, "id": None, "update": False}, _size(plain))

    def finish_displayhook(self) -> None:
        pass


class Transforms(TransformerManager):  # type: ignore[misc]
    """Looks for magics among a cell's tokens only where its text is no plain Python: they all make it so.

    IPython looks in every cell, in Python, which takes longer than most cells.
    """

    def do_token_transforms(self, lines: list[str]) -> list[str]:
        """Replace magics, system commands and questions by calls."""
        if self.token_transformers == _TOKEN_TRANSFORMERS and _plain_python("".join(lines)):
            return lines
        replaced: list[str] = super().do_token_transforms(lines)
        return replaced


_TOKEN_TRANSFORMERS = TransformerManager().token_transformers


def _plain_python(source: str) -> bool:
    try:
        ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    return True


class Shell(InteractiveShell):  # type: ignore[misc]
    """IPython without terminal, history file, start-up files and background threads."""

    displayhook_class = Type(_Result)
    display_pub_class = Type(_Display)
    input_transformer_manager = Instance(Transforms, ())

    def init_history(self) -> None:
        """Keep inputs in memory only."""
        self.history_manager = HistoryManager(shell=self, parent=self, enabled=False)
        self.configurables.append(self.history_manager)

    def should_run_async(self, raw_cell: str, **transformed: Any) -> bool:
        """Whether the cell awaits something; to see that, IPython compiles it once more."""
        awaits = any(word in raw_cell for word in ("await", "async"))
        return awaits and bool(super().should_run_async(raw_cell, **transformed))

    def enable_gui(self, gui: object = None) -> None:
        """There is no window system here; ``%matplotlib inline`` is what is on."""

    def system(self, cmd: str) -> None:
        """``!command``: its output goes to the cell."""
        done = subprocess.run(
            self.var_expand(cmd, depth=1), shell=True, stdin=subprocess.DEVNULL, stdout=-1, stderr=-2, check=False
        )
        sys.stdout.write(done.stdout.decode(errors="replace"))
        self.user_ns["_exit_code"] = done.returncode

    @contextlib.contextmanager
    def _tee(self, channel: str) -> Iterator[None]:
        """IPython would keep all output in memory a second time."""
        yield

    def _showtraceback(self, etype: type, evalue: BaseException, stb: list[str]) -> None:
        _flush()
        lines = [str(line)[:20_000] for line in stb][-60:]
        name = str(getattr(etype, "__name__", etype))[:200]
        try:
            value = str(evalue)[:4_000]
        except Exception:
            value = ""
        output = {"output_type": "error", "ename": name, "evalue": value, "traceback": lines}
        OUTLET.final({"op": "output", "output": output, "id": None, "update": False}, sum(map(len, lines)))


def make_shell() -> Shell:
    """The shell, made before forking, with all that its first cell, error and (with matplotlib) plot would load."""
    shell: Shell = Shell.instance(colors="nocolor")
    if "matplotlib" in sys.modules:  # else the first import of pyplot does it, as in a notebook
        from matplotlib_inline.backend_inline import configure_inline_support

        configure_inline_support(shell, "module://matplotlib_inline.backend_inline")  # type: ignore[no-untyped-call]
        _draw_once()
    for source in ("def _warm():\n    return 1 / 0\n_warm()", "del _warm"):
        shell.run_cell(source, store_history=False)
    builtins.input = _no_input
    return shell


def _draw_once() -> None:
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(1, 1))
    axes.plot([0, 1], label="warm")
    axes.legend()
    figure.savefig(io.BytesIO(), format="png", bbox_inches="tight")
    pyplot.close(figure)


def attach(shell: Shell, send: Send, budget: int) -> None:
    """Let all that cells print and show go to ``send``, at most ``budget`` bytes a cell."""
    OUTLET.send, OUTLET.budget = send, budget
    sys.stdout, sys.stderr = Stream("stdout", 1), Stream("stderr", 2)
    vars(sys).update(__stdout__=sys.stdout, __stderr__=sys.stderr)  # else a way past the limit
    signal.signal(signal.SIGINT, _on_interrupt)


def run_cell(shell: Shell, source: str, number: int) -> bool:
    """Run one cell as the notebook's number ``number``; return whether it ran to its end."""
    global _running
    OUTLET.begin()
    shell.execution_count = number
    result = None
    try:
        _running = True
        result = shell.run_cell(source, store_history=True)
        _running = False
    except BaseException as error:  # what IPython lets through, such as an interrupt at an odd moment
        _show(shell, error)
    finally:
        _running = False
        _flush()
    if (
        result is not None
        and result.error_before_exec is not None
        and not isinstance(result.error_before_exec, SyntaxError)
    ):
        _show(shell, result.error_before_exec)
    return result is not None and bool(result.success)


def _on_interrupt(signum: int, frame: FrameType | None) -> None:
    """Break into the notebook's code, and into nothing else."""
    if _running:
        raise KeyboardInterrupt


def mute() -> None:
    """Let nothing out any more."""
    OUTLET.send = None


def _show(shell: Shell, error: BaseException) -> None:
    shell._showtraceback(type(error), error, [f"{type(error).__name__}: {error}"])


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, Stream):
            stream.flush()


def _plain(bundle: Mapping[str, Any]) -> dict[str, str]:
    """A MIME bundle as text: what is binary in base64, and what is neither is left out."""
    plain = {}
    for kind, value in bundle.items():
        if isinstance(value, bytes):
            plain[str(kind)] = base64.b64encode(value).decode()
        elif isinstance(value, str):
            plain[str(kind)] = value
    return plain


def _size(data: Mapping[str, str]) -> int:
    return sum(len(value) for value in data.values())


def _no_input(prompt: object = "", /) -> str:
    raise RuntimeError(
        "input() does not work while grading: nobody is there to type. Give the value in the code instead."
    )
