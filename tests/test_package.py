"""What a release consists of agrees with itself."""

import re
import tomllib
from pathlib import Path

import gaponet

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_the_version_is_one():
    assert gaponet.__version__ == PROJECT["version"]
    assert f"## {PROJECT['version']}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_page_on_installing_names_every_extra():
    page = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.+?) \|", page, re.MULTILINE)
    assert sorted(re.findall(r"`([a-z0-9]+)`", " ".join(rows))) == sorted(
        set(PROJECT["optional-dependencies"]) - {"dev", "docs"}
    )


def test_a_user_can_see_all_extras_at_a_glance():
    assert len(PROJECT["optional-dependencies"]) <= 14


def test_hosted_workflows_call_what_is_here():
    """A command of a workflow is .ci/run, a make target that the Makefile has, or one of these few
    words.
    """
    targets = set(
        re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    )
    for file in WORKFLOWS:
        text = file.read_text(encoding="utf-8")
        commands = re.findall(r"- run: (.+)$", text, re.MULTILINE)
        assert commands, file
        (matrix,) = re.findall(r"command: \[(.+)\]", text) or [""]
        called = {c.split()[1] for c in commands if c.startswith("make ")} - {'"$COMMAND"'} | set(
            matrix.split(", ")
        ) - {""}
        assert called <= targets, file
        others = [c.split()[0] for c in commands if not c.startswith("make ")]
        assert set(others) <= {".ci/run", "grep", "pipx"}, file


def test_hosted_tests_are_of_every_python_that_the_package_names():
    named = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)}
    matrices = re.findall(
        r"python: \[(.+)\]", (ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8")
    )
    assert len(matrices) == 2
    assert all(set(re.findall(r"[\d.]+", m)) == named for m in matrices)
    assert min(named, key=lambda v: int(v[2:])) == PROJECT["requires-python"].removeprefix(">=")


def test_exact_versions_lie_within_the_ranges():
    """Of the packages that pyproject.toml bounds above and below."""
    exact = dict(
        re.findall(
            r"^([a-z0-9-]+)==(\S+)$",
            (ROOT / "constraints.txt").read_text(encoding="utf-8"),
            re.MULTILINE,
        )
    )
    wanted = [
        line
        for lines in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
        for line in lines
    ]
    number = lambda text: [int(part) for part in re.findall(r"\d+", text)]  # noqa: E731
    for name, low, high in re.findall(
        r"^([a-z0-9-]+)>=([\d.]+)(?:,<([\d.]+))?", "\n".join(wanted), re.MULTILINE
    ):
        if name in exact:
            assert number(low) <= number(exact[name]), name
            assert not high or number(exact[name]) < number(high), name
    assert {"torch", "mujoco", "numpy", "rsl-rl-lib"} <= exact.keys()
