"""The docs say what the code is: files, public names, defaults; and the README stands alone."""

import importlib
import json
import re
import tomllib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

import gaponet as gp
from gaponet.experiments.paper.options import PaperOptions
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import TrainConfig
from gaponet.nn.training.validation import GAINS
from gaponet.sysid.adapt import PRIOR_RAD, SHARED_PRIOR_RATIO

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "gaponet"
FOLDERS = sorted(p.name for p in SOURCE.iterdir() if p.is_dir() and any(p.glob("*.py")))
PAGES = sorted((ROOT / "docs").glob("*.md"))
ALL_PAGES = sorted((ROOT / "docs").glob("**/*.md"))
MODEL = ModelConfig()
TRAIN = TrainConfig()
ONLINE = (
    "https://github.com/gaponet/gaponet/blob/main/",
    "https://raw.githubusercontent.com/gaponet/gaponet/main/",
)


def text(page: str) -> str:
    return re.sub(r"\s+", " ", (ROOT / page).read_text(encoding="utf-8"))


def widths(layers: tuple[int, ...]) -> str:
    return "-".join(map(str, layers))


@pytest.mark.parametrize(
    ("page", "said"),
    [
        (
            "network.md",
            f"Branch ({widths(MODEL.branch_hidden)}, ELU) and trunk ({widths(MODEL.trunk_hidden)})",
        ),
        ("reference/paper-network.md", f"(hidden layers of {widths(MODEL.sensor_hidden)})"),
        ("network.md", f"layers of {widths(MODEL.mlp_hidden)}."),
        ("network.md", f"p = {MODEL.num_basis} features"),
        ("reference/paper-network.md", f"m = {MODEL.num_probes} targets"),
        (
            "reference/paper-network.md",
            f"Those at ±{MODEL.probe_small} rad show gains and friction",
        ),
        ("reference/paper-network.md", f"those at ±{MODEL.probe_large} rad show inertia"),
        ("network.md", f"Δ_max = {MODEL.delta_max} rad"),
        ("network.md", f"{MODEL.observation_dim(10) - 1} for n = 10, H = {MODEL.history}, and"),
        ("reference/paper-network.md", f"own answers at {TRAIN.pretraining.sensor_states} states"),
        ("identification.md", f"an error of {PRIOR_RAD} rad"),
        ("paper.md", f"{PaperOptions().steps:,} control steps"),
    ],
)
def test_a_default_that_a_page_states_is_that_of_the_code(page, said):
    assert said in text(f"docs/{page}")


def test_the_sizes_of_networks_that_a_page_states_are_those_of_the_code():
    networks = importlib.import_module("gaponet.nn.networks")  # loads torch
    for kind in ("gaponet", "shared_mlp", "mlp", "paper"):
        network = networks.build_network(replace(MODEL, kind=kind), n=10)
        assert f"`{kind}`" in text("docs/network.md")
        assert f" {networks.num_parameters(network):,}" in text("docs/network.md")


def test_words_for_fractions_are_the_code_s_too():
    assert GAINS == (3 / 4, 1 / 2, 1 / 4)
    assert "1, ¾, ½ or ¼" in text("docs/network.md")
    assert SHARED_PRIOR_RATIO == 1 / 20
    assert "a twentieth of that" in text("docs/identification.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_source_file_that_a_page_names_is_there(page):
    for name in re.findall(
        rf"`((?:{'|'.join(FOLDERS)})/[a-z0-9_/]*(?:\.py)?)`", page.read_text(encoding="utf-8")
    ):
        assert (SOURCE / name).exists(), f"{page.name}: {name}"


def test_the_architecture_page_names_every_folder_once_and_each_step_of_the_walk_by_its_files():
    page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z]+)/` \|", page, re.MULTILINE)
    assert sorted(rows) == FOLDERS
    twice = {"hw/control/safety.py"}  # judges the state, then the command
    for section in page.split("\n## "):
        if not section.startswith(("One CSV row", "One control period")):
            continue
        steps = re.findall(r"^\d\. (?:.|\n(?!\d\. |\n))+", section, re.MULTILINE)
        assert len(steps) >= 5
        seen = Counter()
        for step in steps:
            seen.update(set(re.findall(r"`([a-z_]+/[a-z0-9_/]+\.py)`", step)))
        assert {file for file, count in seen.items() if count > 1} <= twice


def test_the_api_pages_describe_every_public_name_where_it_lives():
    described = [
        path
        for page in sorted((ROOT / "docs/api").glob("*.md"))
        for path in re.findall(r"^::: (gaponet\w*\.[\w.]+)", page.read_text(encoding="utf-8"), re.M)
    ]
    homes = {path.rpartition(".")[2]: path.rpartition(".")[0] for path in described}
    assert len(homes) == len(described)
    assert {name: getattr(gp, name).__module__ for name in set(dir(gp)) - {"__version__"}} == homes


def test_the_overview_of_the_api_links_each_of_its_pages():
    overview = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs/api").glob("*.md"):
        assert f"(api/{page.name})" in overview, page.name


def test_every_link_of_the_readme_is_absolute_and_leads_to_a_file_that_is_there():
    links = re.findall(r"\]\(([^)]+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert len(links) > 5
    for link in links:
        home = next((home for home in ONLINE if link.startswith(home)), None)
        assert home, f"{link}: a package index has no file beside the README"
        assert (ROOT / link.removeprefix(home)).is_file(), link


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: page.stem)
def test_every_picture_of_a_page_is_there(page):
    """The strict build of the site looks at links alone."""
    for picture in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / picture).is_file(), f"{page.name}: {picture}"


def test_the_navigation_of_the_site_has_every_page():
    site = (ROOT / "zensical.toml").read_text(encoding="utf-8")
    for page in ALL_PAGES:
        assert f'"{page.relative_to(ROOT / "docs").as_posix()}"' in site, page


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings: lower case, no punctuation, hyphens for spaces."""
    heads = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {
        re.sub(r"[ -]+", "-", re.sub(r"[^\w\s-]", "", head.lower())).strip("-") for head in heads
    }


def test_every_link_of_a_page_leads_to_a_page_and_a_heading_that_are_there():
    for page in ALL_PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            file, _, heading = link.partition("#")
            if "://" in link or link.startswith("mailto:"):
                continue
            target = page.parent / file if file else page
            assert target.exists(), f"{page.name}: {link}"
            assert not heading or heading in anchors(target), f"{page.name}: {link}"


def test_every_step_of_the_results_page_is_a_command_of_make_results():
    page = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    steps = tomllib.loads((ROOT / "benchmarks/results.toml").read_text(encoding="utf-8"))["steps"]
    cells = []
    for table in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE):
        head, _, *rows = table.splitlines()
        if "| step" in head:
            cells += [row.strip("|\n").rpartition("|")[2] for row in rows]
    assert len(cells) > 15
    for cell in cells:
        assert any(name in steps for name in re.split(r"[ ,|]+", cell)), cell
    assert set(re.findall(r"[sS]tep ([a-z]\w+_\w+)", page)) <= steps.keys()


@pytest.mark.parametrize(
    ("page", "limit"), [("docs/results.md", 1500), ("docs/results/did-not-work.md", 800)]
)
def test_the_results_stay_short(page, limit):
    assert len(re.findall(r"\S*\w\S*", text(page))) <= limit


def test_the_tables_of_real_robots_are_those_of_the_measured_rows(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    rows = json.loads((ROOT / "docs/results/real.json").read_text(encoding="utf-8"))["rows"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for line in importlib.import_module("results").readme_rows(rows):
        assert line in readme
    page = text("docs/results.md").partition("### Causes")[0]
    shares = {r["set"]: f"{r['of_nominal']:.2f}" for r in rows if r["method"] == "identification"}
    new = {
        "h1_2": next(r for r in rows if (r["set"], r["method"]) == ("h1_2", "identification"))[
            "of_nominal"
        ]
    }
    for name in ("so101", "g1_arms", "go2", "go2_other_lab", "aliengo", "z1", "xl330"):
        assert f" {shares[name]}" in page, name
    assert f"new commands {new['h1_2']:.2f}" in page


def test_every_page_that_llms_txt_names_is_there():
    named = re.findall(
        r"https://gaponet\.github\.io/gaponet/([\w/-]*)", (ROOT / "llms.txt").read_text("utf-8")
    )
    assert len(named) > 15
    for page in named:
        file = f"{page.rstrip('/')}.md" if page else "index.md"
        assert (ROOT / "docs" / file).is_file(), page


@pytest.fixture
def page_numbers(monkeypatch):
    """benchmarks/page_numbers.py, which `make results` runs."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("page_numbers")


def test_the_numbers_of_the_pages_are_those_of_the_results_files(page_numbers):
    for sentence in page_numbers.sentences():
        for name in sentence["pages"]:
            page = (ROOT / name).read_text(encoding="utf-8")
            assert page_numbers.filled(page, sentence) == page, f"{name}: {sentence['text']}"


def test_a_stale_number_of_a_page_is_replaced_also_across_a_line_break(page_numbers):
    commit = page_numbers.value("commit; tournament")
    sentence = {"text": "as {a} measured it", "a": "commit; tournament"}
    assert page_numbers.filled("as 01234567 measured\nit, 3", sentence) == (
        f"as {commit} measured\nit, 3"
    )


def test_a_sentence_that_no_page_has_any_more_is_an_error(page_numbers):
    with pytest.raises(LookupError, match="sentence"):
        page_numbers.filled("other words", {"text": "in {a} s", "a": "seconds; collect"})


def test_the_charts_have_the_numbers_of_the_tables_beside_them(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    for chart in importlib.import_module("page_charts").CHARTS:
        assert (ROOT / "docs" / chart.picture).read_text(encoding="utf-8") == chart.svg()
