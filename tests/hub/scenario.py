"""What a class does, over HTTP and under their own accounts; prints one line for each thing that held."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import requests

HUB = "http://127.0.0.1:8000"
LAB, COURSE = "assessment", "robotbrain"
EXCHANGE, DEPLOYED = Path("/srv/robotbrain/exchange"), Path("/srv/robotbrain/hub")
HOMES = Path("/home")
REPOSITORY = HOMES / "instructor" / "robotbrain"


class TroubleError(Exception):
    """Something did not hold."""


def held(condition: object, what: str) -> None:
    """Print what held, or stop."""
    if not condition:
        raise TroubleError(what)
    print(f"ok  {what}", flush=True)


def as_user(name: str, *command: str, code: int | None = 0) -> str:
    """Run a command under an account, as its server would; return what it printed."""
    private = ["setpriv", "--reuid", name, "--regid", name, "--init-groups", "--no-new-privs"]
    home = f"{HOMES}/{name}"
    environment = {k: os.environ[k] for k in ("PATH", "LANG", "PYTHONPATH", "OMP_NUM_THREADS")}
    environment |= {"HOME": home, "USER": name, "ROBOTBRAIN_EXCHANGE": str(EXCHANGE)}
    done = subprocess.run([*private, *command], cwd=home, env=environment, capture_output=True, text=True, check=False)
    if code is not None and done.returncode != code:
        raise TroubleError(f"{name}: {' '.join(command)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout + done.stderr


class Browser:
    """A user who has logged in to the hub by its form and keeps the cookies."""

    def __init__(self, name: str, password: str = "proof") -> None:
        self.name = name
        self.session = requests.Session()
        page = self.session.get(f"{HUB}/hub/login")
        token = re.search(r'name="_xsrf" value="([^"]+)"', page.text)
        form = {"username": name, "password": password, "_xsrf": token[1] if token else ""}
        self.answer = self.session.post(f"{HUB}/hub/login?next=%2Fhub%2Fhome", data=form)

    @property
    def logged_in(self) -> bool:
        """Whether the hub knows who this is."""
        return self.answer.status_code == 200 and self.answer.url.endswith("/hub/home")

    def open_server(self) -> requests.Response:
        """Start one's own server and return its first page."""
        self.session.get(f"{HUB}/hub/spawn")
        end = time.monotonic() + 180
        while time.monotonic() < end:
            page = self.session.get(f"{HUB}/user/{self.name}/lab")
            if page.status_code == 200 and page.url.startswith(f"{HUB}/user/{self.name}/lab"):
                return page
            time.sleep(1)
        raise TroubleError(f"the server of {self.name} did not start: {page.status_code} {page.url}")

    def get(self, path: str, user: str = "") -> requests.Response:
        """GET from a single-user server."""
        return self.session.get(f"{HUB}/user/{user or self.name}/{path}")

    def post(self, path: str, **form: str) -> Any:
        """POST to one's own server, as its pages do."""
        token = next(c.value for c in self.session.cookies if c.name == "_xsrf" and c.path == f"/user/{self.name}/")
        answer = self.session.post(f"{HUB}/user/{self.name}/{path}", data=form, headers={"X-XSRFToken": token})
        if answer.status_code != 200:
            raise TroubleError(f"{self.name}: POST {path}: {answer.status_code} {answer.text[:500]}")
        return answer.json()

    def assignment(self, answer: Any, status: str) -> dict[str, Any]:
        """The entry of the lab in a list of nbgrader's."""
        if not answer["success"]:
            raise TroubleError(f"{self.name}: {answer['value']}")
        found = [a for a in answer["value"] if a["assignment_id"] == LAB and a["status"] == status]
        if not found:
            raise TroubleError(f"{self.name}: no {LAB} that is {status}: {answer['value']}")
        return dict(found[-1])


def start_hub() -> subprocess.Popen[bytes]:
    """Deploy the documented files and start the hub."""
    DEPLOYED.mkdir(parents=True)
    for name in ("jupyterhub_config.py", "start.py"):
        (DEPLOYED / name).write_bytes((REPOSITORY / "autograder" / "jupyterhub" / name).read_bytes())
    EXCHANGE.mkdir()
    EXCHANGE.chmod(0o1777)
    command = [sys.executable, "-m", "jupyterhub", "--config", str(Path(__file__).with_name("hub_config.py"))]
    with Path("/srv/proof/hub.log").open("wb") as log:
        hub = subprocess.Popen(command, cwd="/srv/proof", stdout=log, stderr=subprocess.STDOUT)
    end = time.monotonic() + 120
    while time.monotonic() < end and hub.poll() is None:
        try:
            if requests.get(f"{HUB}/hub/health", timeout=5).status_code == 200:
                return hub
        except requests.ConnectionError:
            time.sleep(0.5)
    raise TroubleError("the hub did not start")


def fill_in(student: str, right: bool) -> None:
    """Write into a student's own notebook, as that student: all right answers, or none."""
    path = f"{HOMES}/{student}/robotbrain-course/labs/{LAB}/{LAB}.ipynb"
    solved = json.loads((REPOSITORY / "solutions" / LAB / f"{LAB}.ipynb").read_text(encoding="utf-8"))
    answers = {c["metadata"]["nbgrader"]["grade_id"]: c["source"] for c in solved["cells"] if solution(c)}
    code = (
        "import json, sys\n"
        f"path = {path!r}\nbook = json.load(open(path))\nanswers = json.loads(sys.argv[1])\n"
        "for cell in book['cells']:\n"
        "    name = cell['metadata'].get('nbgrader', {}).get('grade_id')\n"
        "    cell['source'] = answers.get(name, cell['source'])\n"
        "json.dump(book, open(path, 'w'))\n"
    )
    as_user(student, sys.executable, "-c", code, json.dumps(answers if right else {}))


def solution(cell: dict[str, Any]) -> bool:
    """Whether students write this cell."""
    return bool(cell["metadata"].get("nbgrader", {}).get("solution"))


def readable(name: str, path: str) -> bool:
    """Whether an account can list a folder or read a file."""
    program = "import os, sys; p = sys.argv[1]; os.listdir(p) if os.path.isdir(p) else open(p, 'rb').read()"
    program += "; print('READ')"
    return "READ" in as_user(name, sys.executable, "-c", program, path, code=None)


def log_in() -> dict[str, Browser]:
    """Everybody logs in and opens their server."""
    held(not Browser("alice", "wrong").logged_in, "a wrong password is refused")
    people = {name: Browser(name) for name in ("instructor", "alice", "bob")}
    for name, person in people.items():
        held(person.logged_in, f"{name} logs in by the hub's form")
        person.open_server()
        api = person.get("api/contents/").json()
        held(isinstance(api.get("content"), list), f"{name}'s own server answers")
    listed = subprocess.run(["ps", "-eo", "user:20,args"], capture_output=True, text=True, check=True).stdout
    owners = {line.split()[0] for line in listed.splitlines() if "jupyterhub.singleuser" in line}
    held(owners == set(people), "each server runs under its own account")
    for student in ("alice", "bob"):
        content = {e["name"] for e in people[student].get("api/contents/").json()["content"]}
        held({"course", "labs", "README.md"} <= content and "autograder" not in content, f"{student} has a copy")
        page = people[student].get("formgrader")
        held(page.status_code == 404, f"{student}'s server has no formgrader")
    held(people["instructor"].get("formgrader").status_code == 200, "formgrader opens for the instructor")
    held(people["bob"].get("api/contents/", user="alice").status_code in (403, 404), "bob cannot enter alice's server")
    held(people["bob"].get("formgrader", user="instructor").status_code in (403, 404), "nor the instructor's")
    return people


def hand_in(people: dict[str, Browser]) -> None:
    """The instructor releases; students fetch, work and submit through their servers' assignment list."""
    print(as_user("instructor", "robotbrain", "generate", LAB, "--course", str(REPOSITORY)).strip())
    print(as_user("instructor", "robotbrain", "exchange", "release", LAB, "--course", str(REPOSITORY)).strip())
    for student, right in (("alice", True), ("bob", False)):
        person = people[student]
        person.assignment(person.get(f"assignments?course_id={COURSE}").json(), "released")
        fetched = person.post("assignments/fetch", assignment_id=LAB, course_id=COURSE)
        person.assignment(fetched, "fetched")
        fill_in(student, right)
        person.post("assignments/submit", assignment_id=LAB, course_id=COURSE)
        submitted = person.assignment(person.get(f"assignments?course_id={COURSE}").json(), "submitted")
        held(submitted, f"{student} fetches and hands in")


def keep_out() -> None:
    """What students can read of others, of the course and of the key."""
    inbound = EXCHANGE / COURSE / "inbound"
    held(not readable("bob", str(inbound)), "bob cannot list what was handed in")
    for student in ("alice", "bob"):
        for path in (REPOSITORY, REPOSITORY / "autograder" / "assessment", REPOSITORY / "autograder" / "gradebook.db"):
            held(not readable(student, str(path)), f"{student} cannot read {path}")
    held(not readable("bob", f"{HOMES}/alice/robotbrain-course/labs/{LAB}/{LAB}.ipynb"), "bob cannot read alice's work")
    held(readable("bob", f"{EXCHANGE}/{COURSE}/outbound/{LAB}/{LAB}.ipynb"), "bob can read what was released")
    before = {p.name for p in (EXCHANGE / COURSE / "outbound").iterdir()}
    as_user("bob", "sh", "-c", f"rm -rf {EXCHANGE}/{COURSE}; touch {EXCHANGE}/{COURSE}/outbound/x", code=None)
    held({p.name for p in (EXCHANGE / COURSE / "outbound").iterdir()} == before, "bob cannot change what was released")
    held(len(list(inbound.iterdir())) == 2, "nor what was handed in")
    for student in ("alice", "bob"):
        held(not seekers_find(student), f"{student} finds no question of the bank anywhere on the machine")


def seekers_find(name: str) -> str:
    """Where an account finds a sentence of the bank."""
    bank = sorted((REPOSITORY / "autograder" / "assessment").glob("*.toml"))[0]
    sentence = tomllib.loads(bank.read_text(encoding="utf-8"))["question"][0]["explain"][:50]
    places = ("/etc", "/home", "/opt", "/run", "/srv", "/tmp", "/usr/local", "/var")
    return as_user(name, "grep", "-rlsF", "--", sentence, *places, code=None)


def cheat() -> None:
    """What bob can do by hand, since everybody may write into the exchange."""
    inbound = EXCHANGE / COURSE / "inbound"
    (own,) = inbound.glob(f"bob+{LAB}+*")
    bank = sorted((REPOSITORY / "autograder" / "assessment").glob("*.toml"))[0]
    as_user("bob", "ln", "-s", str(bank), f"{own}/data.json")
    forged = f"{inbound}/alice+{LAB}+2099-01-01 00:00:00.000000 UTC+x"
    as_user("bob", "mkdir", "-m", "777", forged)
    as_user("bob", "cp", f"{own}/{LAB}.ipynb", forged)


def grade(people: dict[str, Browser]) -> None:
    """The instructor collects, grades in the sandbox, and releases feedback."""
    course = ("--course", str(REPOSITORY))
    collected = as_user("instructor", "robotbrain", "exchange", "collect", LAB, *course)
    print(collected.strip())
    held("data.json is a link" in collected, "a link to the key in bob's folder is not followed")
    held(re.search(r"alice .*2099.*refused.*bob", collected), "what bob hands in as alice is refused")
    submitted = REPOSITORY / "autograder" / "submitted"
    held(not (submitted / "bob" / LAB / "data.json").exists(), "nothing of it reached the grader")
    report = as_user("instructor", "sh", "-c", f"cd {REPOSITORY}; robotbrain doctor", code=None)
    print("\n".join(line for line in report.splitlines() if "sandbox" in line))
    command = f"robotbrain grade-class {LAB} --course {REPOSITORY} --require-sandbox --json --yes 2>/dev/null"
    rows = json.loads(as_user("instructor", "sh", "-c", command))["students"]
    marks = {row["student"]: row["earned"] for row in rows}
    held(marks == {"alice": 100.0, "bob": 0.0}, f"each is graded on what they handed in: {marks}")
    layers = set.intersection(*(set(row["layers"]) for row in rows))
    held({"bubblewrap", "namespaces", "seccomp", "limits", "tester"} <= layers, f"an ordinary user's layers: {layers}")
    assignments = people["instructor"].get("formgrader/api/assignments").json()
    entry = next(a for a in assignments if a["name"] == LAB)
    held(entry["num_submissions"] == 2, "formgrader shows two submissions")
    print(as_user("instructor", "robotbrain", "exchange", "feedback", LAB, *course).strip())


def collect_by_formgrader(people: dict[str, Browser]) -> None:
    """Bob hands in again, with a link; the instructor presses formgrader's button."""
    people["bob"].post("assignments/submit", assignment_id=LAB, course_id=COURSE)
    newest = sorted((EXCHANGE / COURSE / "inbound").glob(f"bob+{LAB}+*"))[-1]
    as_user("bob", "ln", "-s", "/etc/hostname", f"{newest}/again.json")
    answer = people["instructor"].post(f"formgrader/api/assignment/{LAB}/collect")
    folder = REPOSITORY / "autograder" / "submitted" / "bob" / LAB
    stamp = (folder / "timestamp.txt").read_text(encoding="utf-8").strip()
    held(answer["success"] and stamp in newest.name, f"formgrader's Collect takes bob's newer work ({stamp})")
    held(not (folder / "again.json").exists(), "and does not follow his link")
    owners = {p.owner() for p in (REPOSITORY / "autograder" / "submitted").iterdir()}
    held(owners == {"instructor"}, "all of it is the instructor's")


def feedback(people: dict[str, Browser]) -> None:
    """Each student fetches their own feedback, and can read nobody else's."""
    pages = {}
    for student in ("alice", "bob"):
        person = people[student]
        person.post("assignments/fetch_feedback", assignment_id=LAB, course_id=COURSE)
        entry = person.assignment(person.get(f"assignments?course_id={COURSE}").json(), "submitted")
        (submission,) = entry["submissions"]
        held(submission["has_local_feedback"], f"{student} fetches feedback")
        found = list(Path(f"{HOMES}/{student}/robotbrain-course/labs/{LAB}/feedback").rglob("*.html"))
        (pages[student],) = [p.read_text(encoding="utf-8") for p in found]
    held("alice" in pages["alice"] and "bob" not in pages["alice"], "alice's page is alice's")
    held("bob" in pages["bob"] and "alice" not in pages["bob"], "bob's page is bob's")
    folder = EXCHANGE / COURSE / "feedback"
    held(not readable("bob", str(folder)), "bob cannot list the released pages")


def main() -> int:
    """Run it all; return 1 if something did not hold."""
    hub = None
    try:
        hub = start_hub()
        people = log_in()
        hand_in(people)
        keep_out()
        cheat()
        grade(people)
        feedback(people)
        collect_by_formgrader(people)
    except TroubleError as trouble:
        print(f"FAILED  {trouble}", file=sys.stderr)
        log = Path("/srv/proof/hub.log")
        print("\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-40:]), file=sys.stderr)
        return 1
    finally:
        if hub is not None:
            hub.terminate()
            hub.wait(30)
    print("all of it held")
    return 0


if __name__ == "__main__":
    sys.exit(main())
