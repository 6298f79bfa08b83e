from __future__ import annotations

import os
import sys
import textwrap
import warnings
from pathlib import Path
from typing import Any

import pytest

from robotbrain.errors import InputError
from robotbrain.grading import Lab, Report, ScoreError, Student, Suite, Verdict, expect, expect_close, load_hidden_suite
from robotbrain.grading.report import SCORE_MIME
from tests.grading import toylab


def lab_of(code: str, suite: Suite | None = None, name: str = "toy") -> Lab:
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(textwrap.dedent(code), "<cell>", "exec"), namespace)
    return Lab(name, namespace, suite)


def one_test(code: str, test: Any, **options: Any) -> Any:
    """The result of a single test of a single exercise worth 10 points."""
    suite = Suite("demo")
    suite.exercise("answer", points=10)
    suite.hint("think-again", "Think again.")
    suite.test("answer", points=10, **options)(test)
    return lab_of(code, suite, "demo").check("answer").results[0]


SOLVED = "\n".join(toylab.SOLUTIONS.values())


def test_a_right_answer_gets_everything() -> None:
    lab = lab_of(SOLVED)
    for exercise, points in (("scale", 4.0), ("total", 6.0), ("mean", 5.0)):
        assert lab.check(exercise).full
        assert lab.score(exercise) == points
        assert lab.score(exercise, hidden=True) == points


def test_visible_scores_are_scaled_and_hidden_ones_exact() -> None:
    lab = lab_of(SOLVED.replace(" if values else 0.0", ""))
    assert lab.score("mean") == 5.0
    assert "More tests run" in repr(lab.check("mean"))
    assert lab.score("mean", hidden=True) == 3.0


def test_the_mime_bundle_is_what_nbgrader_reads() -> None:
    score = lab_of(SOLVED).score("mean", hidden=True)
    bundle = score._repr_mimebundle_()
    assert float(bundle["text/plain"]) == 5.0
    assert bundle[SCORE_MIME]["earned"] == 5.0
    assert [t["verdict"] for t in bundle[SCORE_MIME]["tests"]] == ["passed", "passed"]
    assert "<table" in bundle["text/html"]


@pytest.mark.parametrize("broken", ["return x * 999", "raise ValueError(f'leak {x}')", "return x.nothing", "exit(x)"])
def test_hidden_tests_do_not_leak(broken: str) -> None:
    lab = lab_of(f"def scale(x):\n    print('seen', x)\n    if x == 3.0:\n        return 6.0\n    {broken}\n")
    score = lab.score("scale", hidden=True)
    assert score == 2.0
    shown = str(score._repr_mimebundle_()) + repr(score.report)
    assert "doubles other numbers" in shown
    assert "Doubling is multiplying by two" in shown
    for secret in ("41.5", "83", "SECRET"):
        assert secret not in shown


def test_a_made_up_exception_name_does_not_carry_a_hidden_input_out() -> None:
    lab = lab_of("def scale(x):\n    raise type(f'Leak{abs(int(x))}', (Exception,), {})()\n")
    assert "Leak41" not in str(lab.score("scale", hidden=True)._repr_mimebundle_())


def test_upstream_mistakes_are_replaced_by_the_reference_also_in_the_students_own_calls() -> None:
    lab = lab_of(SOLVED.replace("2 * x", "x ** 2"))
    assert lab.check("scale").earned == 0
    report = lab.check("total")
    assert report.full
    assert report.substituted == ("scale",)
    assert "reference for scale" in repr(report)
    assert lab._namespace["scale"](3.0) == 9.0  # the student's own function is back afterwards


def test_a_missing_upstream_part_is_lent_and_taken_back() -> None:
    lab = lab_of(toylab.SOLUTIONS["total"])
    assert lab.check("total").full
    assert "scale" not in lab._namespace
    assert "not defined" in lab.check("scale").results[0].message


def test_a_correct_upstream_part_is_used_itself() -> None:
    lab = lab_of(SOLVED.replace("def scale(x):", "def scale(x):\n    calls.append(x)") + "\ncalls = []")
    report = lab.check("total")
    assert report.full and report.substituted == ()
    assert 2.0 in lab._namespace["calls"]


def test_upstream_results_follow_the_students_corrections() -> None:
    lab = lab_of(SOLVED.replace("2 * x", "x ** 2"))
    assert lab.check("total").substituted == ("scale",)
    exec(toylab.SOLUTIONS["scale"], lab._namespace)
    assert lab.check("total").substituted == ()


def test_siblings_do_not_see_each_others_references() -> None:
    suite = Suite("demo")
    suite.exercise("a", points=1)
    suite.exercise("b", points=1)
    suite.exercise("c", points=1, upstream=("a", "b"))
    suite.reference("a", lambda: lambda: 1)
    suite.reference("b", lambda: lambda: 1)
    for name in "abc":
        suite.test(name, points=1)(lambda student, name=name: expect_close(student[name](), 1))
    lab = lab_of("def a(): return 0\ndef b(): return a() + 1\ndef c(): return a() * b()", suite, "demo")
    assert lab.check("c").substituted == ("a",)


def test_partial_credit_by_fraction_and_by_expectation() -> None:
    assert one_test("", lambda student: 0.25).earned == 2.5
    assert one_test("", lambda student: True).verdict is Verdict.PASSED
    result = one_test("", lambda student: expect(False, credit=0.5))
    assert (result.earned, result.verdict) == (5.0, Verdict.FAILED)
    assert "broken" in one_test("", lambda student: 7).message


def test_not_written_yet_is_not_called_wrong() -> None:
    result = one_test("def f():\n    raise NotImplementedError()", lambda student: student.f(), hint="think-again")
    assert result.verdict is Verdict.NOT_WRITTEN
    assert result.message == "f is not written yet"
    assert result.hint == ""


def test_an_exception_names_the_students_line() -> None:
    code = "def f(x):\n    y = x\n    return g(y)\n\ndef g(y):\n    return y + None\n"
    result = one_test(code, lambda student: student.f(1), hint="think-again")
    assert result.verdict is Verdict.ERROR
    assert "TypeError in line 6 of g" in result.message
    assert result.hint == "Think again."


def test_an_unusable_return_value_is_not_blamed_on_a_line() -> None:
    result = one_test("def f(): return None", lambda student: len(student.f()))
    assert "could not use what your code gave it (TypeError" in result.message


@pytest.mark.parametrize(
    "loop",
    [
        "while True: pass",
        "while True:\n        try:\n            pass\n        except Exception:\n            pass",
        "while True:\n        try:\n            time.sleep(0.001)\n        except:\n            pass",
        "while True:\n        try:\n            while True: pass\n        except BaseException:\n            continue",
    ],
)
def test_endless_loops_are_interrupted(loop: str) -> None:
    result = one_test(f"import time\ndef f():\n    {loop}\n", lambda student: student.f(), time_limit_s=0.2)
    assert result.verdict is Verdict.TIMEOUT
    assert "did not finish in 0.2 s" in result.message
    assert sys.gettrace() is None or "coverage" in sys.modules or "pydevd" in sys.modules


def test_a_time_scale_stretches_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTBRAIN_TIME_SCALE", "3")
    result = one_test("def f():\n    while True: pass", lambda student: student.f(), time_limit_s=0.1)
    assert "0.3 s" in result.message


def test_prints_and_warnings_cost_nothing_and_stay_out(capsys: pytest.CaptureFixture[str]) -> None:
    code = "import sys, warnings\ndef f():\n    print('hello'); print('x', file=sys.stderr); warnings.warn('w')\n"
    with warnings.catch_warnings(record=True) as caught:
        assert one_test(code, lambda student: student.f()).verdict is Verdict.PASSED
    assert not caught
    assert capsys.readouterr() == ("", "")
    shown = one_test(code, lambda student: (student.f(), expect(False)))
    assert "hello" in shown.printed


def test_printing_for_ever_keeps_little() -> None:
    result = one_test("def f():\n    while True: print('x' * 1000)", lambda s: s.f(), time_limit_s=0.2)
    assert result.verdict is Verdict.TIMEOUT
    assert len(result.printed) < 5_000


def test_the_global_random_state_is_fixed_in_a_test_and_restored() -> None:
    import random

    seen: list[float] = []
    random.seed(1)
    before = random.getstate()
    for _ in range(2):
        one_test("import random\ndef f(): return random.random()", lambda student: seen.append(student.f()))
    assert seen[0] == seen[1]
    assert random.getstate() == before


def test_seeds_differ_between_students_and_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    def draw(label: str) -> float:
        return float(Student({}, "toy", frozenset()).rng(label).random())

    anonymous = draw("a")
    assert draw("a") == anonymous != draw("b")
    monkeypatch.setenv("NBGRADER_STUDENT", "amara")
    assert draw("a") != anonymous


FORBIDDEN = {
    "the object itself": "from os.path import join as answer",
    "a wrapper": "from os.path import join\ndef answer(*a): return join(*a)",
    "through the module": "import os.path as p\ndef answer(*a): return p.join(*a)",
    "imported inside": "def answer(*a):\n    from posixpath import join\n    return join(*a)",
    "by importlib": "import importlib\ndef answer(*a): return importlib.import_module('posixpath').join(*a)",
    "behind a helper": "from os.path import join\ndef helper(*a): return join(*a)\ndef answer(*a): return helper(*a)",
    "by inheritance": "from pathlib import PurePosixPath\nclass answer(PurePosixPath): pass",
    "in a class": "from os.path import join\nclass answer:\n    def run(self, *a): return join(*a)",
}


def _banned_suite() -> Suite:
    suite = Suite("demo")
    suite.exercise("answer", points=10)
    suite.reference("answer", "posixpath:join")
    suite.forbid("answer", imports=("posixpath", "pathlib"), allow=("basename",))
    suite.test("answer", points=10)(lambda student: None)
    return suite


@pytest.mark.skipif(os.name != "posix", reason="os.path is posixpath there only")
@pytest.mark.parametrize("code", FORBIDDEN.values(), ids=FORBIDDEN.keys())
def test_the_courses_own_solution_is_refused(code: str) -> None:
    result = lab_of(code, _banned_suite(), "demo").check("answer").results[0]
    assert result.verdict is Verdict.FORBIDDEN
    assert "own" in result.message


@pytest.mark.skipif(os.name != "posix", reason="os.path is posixpath there only")
def test_own_answers_and_allowed_names_are_not_refused() -> None:
    code = "from os.path import basename\ndef answer(*a): return '/'.join(basename(x) for x in a)"
    assert lab_of(code, _banned_suite(), "demo").check("answer").full


def test_a_reference_that_stands_in_upstream_is_not_held_against_the_student() -> None:
    suite = Suite("demo")
    suite.exercise("joined", points=1)
    suite.exercise("answer", points=10, upstream=("joined",))
    suite.reference("joined", "posixpath:join")
    suite.forbid("joined", imports=("posixpath",))
    suite.forbid("answer", imports=("posixpath",))
    suite.test("joined", points=1)(lambda student: expect(student.joined("a", "b") == "a/b"))
    suite.test("answer", points=10)(lambda student: expect(student.answer() == "a/b"))
    lab = lab_of("def joined(*a): return 'wrong'\ndef answer(): return joined('a', 'b')", suite, "demo")
    report = lab.check("answer")
    assert report.full
    assert report.substituted == ("joined",)


def test_validate_shows_the_report_as_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NBGRADER_VALIDATING", "1")
    lab = lab_of(SOLVED.replace("2 * x", "x ** 2"))
    with pytest.raises(ScoreError, match="doubles a number") as caught:
        lab.score("scale")
    shown = "\n".join(caught.value._render_traceback_())
    assert "Doubling is multiplying by two" in shown
    assert "Traceback" not in shown
    assert max(map(len, shown.splitlines())) < 87  # nbgrader cuts there
    assert lab.score("mean") == 5.0


def test_visible_tests_run_once_in_a_graded_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = lab_of("calls = []\ndef scale(x):\n    calls.append(x)\n    return 2 * x")
    monkeypatch.setattr("robotbrain.grading.lab._current_cell", lambda: 7)
    assert lab.score("scale") == lab.score("scale", hidden=True) == 4.0
    assert lab._namespace["calls"] == [3.0, -41.5]
    monkeypatch.setattr("robotbrain.grading.lab._current_cell", lambda: 8)
    lab.score("scale")
    assert lab._namespace["calls"] == [3.0, -41.5, 3.0]


def test_an_interrupted_cell_keeps_what_was_earned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NBGRADER_EXECUTION", "autograde")
    suite = Suite("demo")
    suite.exercise("answer", points=3)

    def interrupted(student: Student) -> None:
        raise KeyboardInterrupt

    suite.test("answer", points=1, name="a")(lambda student: None)
    suite.test("answer", points=1, name="b")(interrupted)
    suite.test("answer", points=1, name="c")(lambda student: None)
    report = lab_of("", suite, "demo").score("answer").report
    assert [r.verdict for r in report.results] == [Verdict.PASSED, Verdict.TIMEOUT, Verdict.TIMEOUT]
    monkeypatch.delenv("NBGRADER_EXECUTION")
    with pytest.raises(KeyboardInterrupt):
        lab_of("", suite, "demo").score("answer")


def test_while_grading_a_check_runs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NBGRADER_EXECUTION", "autograde")
    lab = lab_of("calls = []\ndef scale(x):\n    calls.append(x)\n    return 2 * x")
    assert "score below" in repr(lab.check("scale"))
    assert lab._namespace["calls"] == []


def test_an_unknown_exercise_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match="one of scale, total, mean"):
        lab_of(SOLVED).check("scael")


def test_html_is_escaped_and_says_verdicts_in_words() -> None:
    lab = lab_of("def scale(x): return '<script>alert(1)</script>'")
    html = lab.check("scale")._repr_html_()
    assert "<script>" not in html
    assert "failed" in html and "<caption" in html and 'scope="col"' in html


def test_the_lab_takes_the_callers_globals() -> None:
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(SOLVED + "\nfrom robotbrain.grading import Lab\nreport = Lab('toy').check('scale')", namespace)
    assert isinstance(namespace["report"], Report) and namespace["report"].full


def test_hidden_points_cannot_exceed_the_exercise(tmp_path: Path) -> None:
    (tmp_path / "hidden").mkdir()
    (tmp_path / "hidden" / "toy.py").write_text(toylab.HIDDEN.replace("points=2", "points=3"))
    with pytest.raises(InputError, match="exactly 4"):
        load_hidden_suite("toy", tmp_path)
