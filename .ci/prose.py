"""Count hard sentences of README and docs, and a ratchet: the numbers of a page in .ci/prose.toml may only fall.

    python .ci/prose.py           a table; exit code 1 where a page has more than allowed
    python .ci/prose.py PAGE …    print what is counted on these pages
    python .ci/prose.py --write   allow what is there now where that is less; forget pages that are gone

Tables, code, headings and link targets are not read. A page that is not listed may have none.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMITS = ROOT / ".ci" / "prose.toml"
MAX_WORDS = 25
COLUMNS = ("long sentences", "forbidden words", "numbers in brackets")
FORBIDDEN = re.compile(
    r"\b(asked|dealt|found|free runs?|held out|kept|laws?|limbs?|looked|surely|takes? off|told|twins?|unsaid)\b",
    re.IGNORECASE,
)
BRACKET = re.compile(r"\([^()]*(?<![\w.-])\d[\d.,]*(?![\w-])[^()]*\)")


def paragraphs(page: str) -> list[str]:
    """Return the running text of a page: one string per paragraph or list item, without markup."""
    page = re.sub(r"^---\n.*?\n---\n|<!--.*?-->|^ *(```|~~~).*?^ *\1", "", page, flags=re.MULTILINE | re.DOTALL)
    page = re.sub(r"^(    .*|\s*\|.*|#.*|:::.*|</?\w.*)$", "", page, flags=re.MULTILINE)
    page = re.sub(r"^\s*([-*]|\d+\.) ", "\n\n", page, flags=re.MULTILINE)
    page = re.sub(r"!?\[((?:[^][]|\[[^]]*\])*)\]\([^)]*\)|<http[^>]*>", lambda m: m[1] or "address", page)
    page = re.sub(r"`[^`]*`", "Code", page)  # a sentence may begin with it
    return [" ".join(p.replace("**", "").split()) for p in re.split(r"\n\s*\n", page) if p.strip()]


def counted(page: Path) -> tuple[list[str], list[str], list[str]]:
    """Return the long sentences, the forbidden words in their surroundings, and the numbers in brackets."""
    texts = paragraphs(page.read_text(encoding="utf-8"))
    sentences = [s for text in texts for s in re.split(r"(?<=[.!?])\s+(?=[^a-z]|gaponet)", text)]
    words = [text[max(m.start() - 30, 0) : m.end() + 30] for text in texts for m in FORBIDDEN.finditer(text)]
    return [s for s in sentences if len(re.findall(r"\w\S*", s)) > MAX_WORDS], words, [
        m[0] for text in texts for m in BRACKET.finditer(text)
    ]  # fmt: skip


def main(arguments: list[str]) -> int:
    pages = {p.relative_to(ROOT).as_posix(): counted(p) for p in (ROOT / "README.md", *ROOT.glob("docs/**/*.md"))}
    for name in (a for a in arguments if a != "--write"):
        for column, texts in zip(COLUMNS, pages[name], strict=True):
            print(f"{name}: {len(texts)} {column}", *texts, sep="\n  ")
    allowed = tomllib.loads(LIMITS.read_text(encoding="utf-8")) if LIMITS.is_file() else {}
    found = {name: [len(texts) for texts in pages[name]] for name in sorted(pages)}
    if "--write" in arguments:
        lowest = {n: [min(x) for x in zip(c, allowed.get(n, (0, 0, 0)), strict=True)] for n, c in found.items()}
        lines = [f'"{name}" = {counts}' for name, counts in lowest.items() if any(counts)]
        LIMITS.write_text(f"# {', '.join(COLUMNS)}: see .ci/prose.py.\n" + "\n".join(lines) + "\n", encoding="utf-8")
        return 0
    print(f"{'':<32}" + "".join(f"{c:>21}" for c in COLUMNS))
    for name, counts in found.items():
        print(f"{name:<32}" + "".join(f"{c:>21}" for c in counts))
    worse = [
        f"{name}: {count} {column}, allowed {limit}"
        for name, counts in found.items()
        for column, count, limit in zip(COLUMNS, counts, allowed.get(name, (0, 0, 0)), strict=True)
        if count > limit
    ]
    for line in worse:
        print(f"more than allowed: {line}; python .ci/prose.py {line.partition(':')[0]} shows them")
    return bool(worse)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
