"""Everything a student can write, in every place it can reach, must come out as harmless text."""

from __future__ import annotations

import base64
import hashlib
import re

import pytest
from nbconvert.filters.markdown_mistune import markdown2html_mistune as markdown2html

from robotbrain.grading.report import SCORE_MIME
from robotbrain.grading.reports import cells, classpage, exporter, feedback, page, similarity, similarity_page
from robotbrain.grading.reports.export import harmless
from robotbrain.grading.reports.grades import Given, GradedNotebook
from robotbrain.grading.reports.model import graded_class, outcomes_of

from . import reportclass as made
from .reportclass import new_output

PAYLOADS = [
    "<script>alert(1)</script>",
    "</pre><script>alert(1)</script>",
    "</style><script>alert(1)</script>",
    "</title><svg onload=alert(1)>",
    "--><script>alert(1)</script><!--",
    "]]><script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "<img src=x onerror=alert(1)//",
    "<IMG SRC=JaVaScRiPt:alert(1)>",
    "<svg/onload=alert(1)>",
    "<svg><animate attributeName=href values=javascript:alert(1) /></svg>",
    "<svg><use href=\"data:image/svg+xml,<svg id='x' xmlns='http://www.w3.org/2000/svg'/>#x\"/></svg>",
    "<math><mtext><table><mglyph><style><img src=x onerror=alert(1)>",
    "<iframe src=javascript:alert(1)></iframe>",
    "<iframe srcdoc='<script>alert(1)</script>'></iframe>",
    "<object data=javascript:alert(1)></object>",
    "<embed src=//evil.example/x.swf>",
    "<base href=//evil.example/>",
    "<meta http-equiv=refresh content='0;url=javascript:alert(1)'>",
    "<link rel=stylesheet href=//evil.example/x.css>",
    "<style>@import '//evil.example/x.css';</style>",
    "<style>body{background:url(//evil.example/?leak)}</style>",
    "<form action=//evil.example><input name=q autofocus onfocus=alert(1)></form>",
    "<details open ontoggle=alert(1)>",
    "<body onload=alert(1)>",
    "<a href='javascript:alert(1)'>here</a>",
    "<a href='data:text/html,<script>alert(1)</script>'>here</a>",
    "[here](javascript:alert(1))",
    "![x](javascript:alert(1))",
    "`<script>alert(1)</script>`",
    "`\" onmouseover=alert(1) x=\"`",
    '" onmouseover="alert(1)',
    "' onmouseover='alert(1)",
    '" autofocus onfocus=alert(1) x="',
    "\"><script>alert(1)</script>",
    "'><img src=x onerror=alert(1)>",
    "javascript:alert(1)",
    "{{ 7 * 7 }}{% for x in ().__class__.__base__.__subclasses__() %}{{ x }}{% endfor %}",
    "{{ config.__class__.__init__.__globals__ }}",
    "{# comment #}{% raw %}",
    "&lt;script&gt;alert(1)&lt;/script&gt;",
    "&#60;script&#62;alert(1)&#60;/script&#62;",
    "\x00<scr\x00ipt>alert(1)</scr\x00ipt>",
    "\ufeff<script>alert(1)</script>",
    "\u202e<script>txt.exe",
    "\x1b]8;;javascript:alert(1)\x1b\\link\x1b]8;;\x1b\\",
    "\x1b[31m<script>alert(1)</script>\x1b[0m",
    "\x9b31m<b>",
    "\ud800<script>alert(1)</script>",
    "<scr<script>ipt>alert(1)</scr</script>ipt>",
    "<x onclick=alert(1)>",
    "<template><script>alert(1)</script></template>",
    "<noscript><p title=\"</noscript><img src=x onerror=alert(1)>\">",
    "<textarea></textarea><script>alert(1)</script>",
    "<plaintext>",
    "<!--",
    "<![CDATA[",
    "<?php phpinfo(); ?>",
    "%3Cscript%3Ealert(1)%3C/script%3E",
    "$\\href{javascript:alert(1)}{x}$",
    "<a id=main name=main>",
    "a\u0300" * 5 + "\u0301" * 5000,
]  # fmt: skip


def everywhere(payload: str) -> str:
    """A feedback page with ``payload`` in every place that foreign text reaches."""
    test = made.test_entry(payload, share=0.5, reread=payload, printed=payload)
    test |= dict.fromkeys(("message", "given", "expected", "got", "misconception", "hint", "hint_key"), payload)
    entry = made.exercise("scale", [test], error=payload, substituted=[payload])
    row = made.student("x", [entry], incidents=[payload], layers=[payload])
    marks = graded_class({"lab": payload, "students": [row]}).rows[0]
    marks.student = payload
    data = {"text/html": payload, "image/svg+xml": payload, "application/javascript": payload, "text/plain": payload}
    outputs = [
        new_output("stream", text=payload),
        new_output("display_data", data=data),
        new_output("display_data", data={"image/png": payload}),
        new_output("display_data", data={payload: payload}),
        new_output("error", ename=payload, evalue=payload, traceback=[payload]),
        new_output("error", ename=payload, evalue=payload, traceback=[]),
    ]
    book = made.notebook(
        made.answer(payload, *outputs, grade_id=payload),
        made.answer("# " + payload, kind="text"),
        report={"title": payload, "tests": []},
    )
    book.cells[0].source = "# " + payload
    given = GradedNotebook({"score-scale": Given(1.0, 2.0, 1.0, 0.5)}, {"scale": payload, payload: payload}, 0.5)
    return feedback.feedback_page(marks, book, lab=payload, graded=given)


@pytest.mark.parametrize("payload", PAYLOADS)
def test_feedback_shows_payloads_as_text_only(payload: str) -> None:
    text = everywhere(payload)
    read = made.Page(text)
    assert read.problems == []
    assert len(set(read.ids)) == len(read.ids)
    assert not page._UNSAFE.search(text)
    text.encode("utf-8")
    # It is there, as text: what is left of the payload after cleaning is told, not swallowed.
    assert " ".join(page.clean(payload).split())[:40] in " ".join(read.text.split())


@pytest.mark.parametrize("payload", PAYLOADS)
def test_class_and_similarity_pages_show_payloads_as_text_only(payload: str) -> None:
    test = made.test_entry(payload, share=0.0, hint=payload, misconception=payload)
    row = made.student("x", [made.exercise(payload, [test], error=payload)], incidents=[payload])
    graded = graded_class({"lab": payload, "students": [row, row | {"student": "y"}]})
    graded.rows[0].student = payload
    text = classpage.class_page(graded, {payload: "feedback/" + payload, "y": "a.html"}, similarity="similarity/i.html")
    code = [
        "def f(a, b):\n    return [a * i + b // 2 for i in range(len(b)) if a > i and not b]\n" * 4,
        payload,
        "#" + payload,
    ]
    found = similarity.compare_class({payload: code, "y": code}, references={payload: code})
    assert found.pairs and found.with_reference
    pages = [text, similarity_page.pair_page(payload, found.pairs[0])]
    for made_page in pages:
        read = made.Page(made_page)
        # A student's folder may have any name: the link to it is quoted, so that it stays a path.
        assert [p for p in read.problems if not re.match(r"a href='feedback/[\w.~%/-]*'", p)] == []
        assert len(set(read.ids)) == len(read.ids)
        assert not page._UNSAFE.search(made_page)


@pytest.mark.parametrize("payload", PAYLOADS)
def test_html_that_formgrader_shows_a_teacher_does_nothing(payload: str) -> None:
    shown = exporter.harmless_html(markdown2html(payload)) + exporter.harmless_html(payload)
    assert set(re.findall(r"</?(\w+)", shown)) <= set(exporter.TAGS)
    tags = "".join(re.findall(r"<[^>]*>", shown))
    assert not re.search(r"\son\w+=|\ssrc=|\sstyle=|\sid=|href=.(?!https?:|//|#|%3C)", tags)


def test_policy_allows_this_style_sheet_and_nothing_else() -> None:
    text = everywhere("x")
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    style = re.search(r"<style>(.*?)</style>", text, re.S)
    assert policy and style
    digest = base64.b64encode(hashlib.sha256(style[1].encode()).digest()).decode()
    directives = dict(d.strip().split(" ", 1) for d in policy[1].replace("&#39;", "'").split(";"))
    assert directives == {
        "default-src": "'none'",
        "style-src": f"'sha256-{digest}'",
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    assert text.index("Content-Security-Policy") < text.index("<title>")


def test_pictures_are_png_by_their_bytes_or_not_there() -> None:
    def pictures(*values: object) -> list[str]:
        outputs = [new_output("display_data", data={"image/png": v}) for v in values]
        return [o.kind for o in cells.own_cells(made.notebook(made.answer("1", *outputs)).cells)[0].outputs]

    svg = base64.b64encode(b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>").decode()
    assert pictures(made.png64(), [made.png64()[:8], made.png64()[8:]]) == ["picture", "picture"]
    huge_claim = base64.b64encode(made.png()[:16] + b"\x7f\xff\xff\xff" * 2 + made.png()[24:]).decode()
    other = base64.b64encode(b"GIF89a\0\0" + made.png()[8:]).decode()
    bad = [svg, other, "x' onerror='alert(1)", "", "é", 7, None, {"a": 1}, made.png64()[:20], huge_claim]
    assert pictures(*bad) == ["note"] * len(bad)
    too_large = base64.b64encode(made.png() + b"\0" * cells.LARGEST_PICTURE).decode()
    assert pictures(too_large) == ["note"]


def test_output_is_bounded_in_every_direction() -> None:
    flood = [new_output("stream", text="x" * 1_000_000) for _ in range(500)]
    flood += [new_output("display_data", data={"image/png": base64.b64encode(made.png() + b"\0" * 1_900_000).decode()})]
    book = made.notebook(*[made.answer("y = 1\n" * 200_000, *flood[:-1])], made.answer("z", *flood[-1:] * 20))
    row = graded_class(
        {"lab": "toy", "students": [made.student("x", [made.exercise("scale", [made.test_entry("n" * 10**6)])])]}
    ).rows[0]
    text = feedback.feedback_page(row, book, lab="toy")
    size, told = len(text), [w in text for w in ("more characters", "more outputs are not shown", "too large for this")]
    assert size < 1.5 * cells.LARGEST_PAGE  # no long text in an assertion: explaining its failure would take minutes
    assert told == [True, True, True]


def test_forged_reports_in_a_graded_cell_are_read_as_data() -> None:
    tests = [None, 7, "x", [], {"name": 3, "verdict": "excellent", "points": "many", "earned": float("inf")}]
    forged = {"title": ["<b>"], "tests": tests, "substituted": [{"a": 1}]}
    book = made.notebook(made.answer("x"), report=forged)
    row = graded_class({"lab": "toy", "students": [made.student("x", [made.exercise("scale", [])])]}).rows[0]
    row.marks[0].tests = tests  # type: ignore[assignment]
    assert [(o.name, o.verdict, o.points, o.earned) for o in outcomes_of(row.marks[0])] == [("3", "error", 0.0, 0.0)]
    assert made.Page(feedback.feedback_page(row, book, lab="toy")).problems == []


def test_hidden_tests_show_name_verdict_and_hint_only() -> None:
    secret = {k: f"SECRET-{k}" for k in ("message", "given", "expected", "got", "misconception", "printed")}
    for hidden in ({"hidden": True}, {"hidden": None}, {"hidden": "no"}, {}):
        test = made.test_entry("of other lists", share=0.0, hint="Count again.", reread="Part 2") | secret
        test.pop("hidden")
        entry = made.exercise("scale", [test | hidden])
        row = graded_class({"lab": "toy", "students": [made.student("x", [entry])]})
        pages = [
            feedback.feedback_page(row.rows[0], made.notebook(made.answer("x")), lab="toy"),
            classpage.class_page(row, {}),
        ]
        assert all("SECRET" not in p for p in pages)
        assert "of other lists" in pages[0] and "Count again." in pages[0] and "hidden test" in pages[0]


def test_locked_cells_and_scores_are_not_repeated() -> None:
    book = made.notebook(made.answer("mine = 1"), report={"title": "Scale", "tests": []})
    book.cells[-1].source = "assert f(41) == 'SECRET'\nlab.score('scale', hidden=True)"
    score = new_output("display_data", data={"text/html": "<b>forged</b>", SCORE_MIME: {"tests": []}})
    book.cells[1].outputs = [score]
    shown = cells.own_cells(book.cells)
    assert [c.source for c in shown] == ["mine = 1"] and shown[0].outputs == []


@pytest.mark.parametrize(
    "value", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\n=1", " =1", "＝1", "=", "\x00=1", "\x1b[0m=1"]
)
def test_spreadsheet_cells_begin_no_formula(value: str) -> None:
    text = harmless(value)
    assert text[:1] not in "=+-@＝＋－＠\t\r\n" and "\n" not in text
    assert harmless("plain text") == "plain text"


def test_clean_keeps_what_people_write() -> None:
    kept = "Größe = 5 µm\n\tПривет, 世界 👍 e\u0301"
    assert page.clean(kept) == kept
    assert page.clean("\x1b[1;31mred\x1b[0m") == "red"
    assert page.clean("a" * 30, 10) == "a" * 10 + "\n… (20 more characters)"
