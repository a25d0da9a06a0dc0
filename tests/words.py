"""Check the wording of the repository: the field's words, plain sentences, American spelling.

    python -m tests.words                     check every tracked .py and .md file
    python -m tests.words egosim_jax/state    check these files and folders
    python -m tests.words --draw 20 --seed 0  print docstring first lines drawn at random

Comments, docstrings, messages, identifiers and Markdown are read. A string without white space is a
key or a path, not prose. In Markdown, no sentence has more than 35 words, and the mean over all
pages is at most 16. Tables, headings and code are not counted.
"""

from __future__ import annotations

import argparse
import ast
import io
import random
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

_ISE = (
    "authori|capitali|categori|characteri|customi|digiti|discreti|emphasi|equali|factori|finali|"
    "generali|harmoni|ideali|initiali|lineari|locali|materiali|maximi|memori|minimi|normali|optimi|"
    "organi|parametri|penali|polari|prioriti|quanti|randomi|rasteri|reali|recogni|regulari|seriali|"
    "speciali|stabili|standardi|summari|symboli|synchroni|tokeni|utili|vectori|visuali|voxeli"
)
_SPATIAL = "(?:within|on|outside|inside|between|behind|in front|above|below)"

PHRASES = {
    # American spelling
    rf"\w*(?:{_ISE})s(?:e|ed|er|ers|es|ing|ation|ations|able)": "-ize",
    r"\w*colour\w*": "color",
    r"\w*(?:neigh|har)bour\w*|\w*behaviour\w*|(?:dis)?honour\w*|(?:un)?favour\w*|labour\w*": "-or",
    r"\w*centre[ds]?|centring|metres?|\w+(?:centi|milli|kilo)metres?|fibres?|litres?": "-er",
    r"grey\w*": "gray",
    r"licen[c]es?|defence|offence": "-se",
    r"analys(?:e|ed|er|ers|ing)": "analyze",
    r"artefacts?": "artifact",
    r"cancell(?:ed|ing)|labell(?:ed|ing)|modell(?:ed|ing)|travell(?:ed|ing)|levell(?:ed|ing)": (
        "one l"
    ),
    r"catalogues?|programmes?|judgement|fulfil|whilst|amongst|learnt|spelt": "American spelling",
    # the field's words
    r"things?": "object, or the noun itself",
    rf"(?:lies?|lay|lying)(?! {_SPATIAL})": "is, is stored",
    r"stands?(?! for| on)": "is, remains",
    r"tells|told": "specify, given, report",
    r"(?:left|leaves?|leaving) out": "skip, omit, drop",
    r"of (?:its|their|one's|his|her) own": "its own, separate",
    r"(?:come|comes|came) by": "obtain",
    r"foretells?|foretold": "predict",
    r"afresh|anew": "again, from scratch",
    r"beside": "versus, next to, along with",
    r"people": "humans, users",
    r"sound": "valid; audio",
    r"pictures?|pictured": "image, frame",
    r"(?-i:MOST|LEAST)(?= )": "MAX_, MIN_",
}
"""Regular expressions of words in prose and in identifiers, and what to write instead."""

PROSE = {
    r"tell(?! apart)": "specify, report",
    r"answers?|answered": "return, output",
    r"(?:go|goes|going|went) on": "continue",
    r"(?<!ground )(?<!ground-)truths?|true clips?": "ground truth, target",
    r"(?:is|are|was|were|be|stay|stays|comes|appears|them|it|found) whole|whole or absent": (
        "atomic, complete"
    ),
    r"the way out": "fix",
    r"twice there|there twice": "duplicate",
    r"(?:that|those) of(?! which)": "name the noun again",
    r"(?:of|by) which": "a second sentence",
    r"what is(?! the matter)": "the noun itself",
    r"(?-i:is none|are none)": "there is no, is not",
}
"""Regular expressions of words in prose alone."""

OPENINGS = re.compile(r"(?:What|How|Of|Those|That|Whether|Where|Which|Who|Why)\b")
"""Words with which the first line of a docstring does not make sense alone."""

MAX_SENTENCE, MAX_MEAN_SENTENCE = 35, 16.0
"""Maximum length of a sentence in Markdown, and of the mean over all pages, in words."""

ALLOWED: dict[tuple[str, str], str] = {
    ("tests/words.py", "*"): "the list itself",
}
"""Per file, a matched word (or `*`) that stays, and the reason."""

_WORDS, _PROSE = (
    [(re.compile(rf"\b(?:{pattern})\b", re.I), fix) for pattern, fix in rules.items()]
    for rules in (PHRASES, PHRASES | PROSE)
)
_DEFINITIONS = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True)
class Finding:
    """A word to replace, and its position in the repository."""

    path: str
    line: int
    word: str
    fix: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.word} -> {self.fix}"


def main(args: list[str] | None = None) -> int:
    """Check files, or draw docstring first lines; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.words", description=__doc__)
    parser.add_argument("paths", nargs="*", help="files and folders; the whole tree if none")
    parser.add_argument("--draw", type=int, help="print so many docstring first lines instead")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    given = parser.parse_args(args)
    files = tracked(given.paths)
    if given.draw is not None:
        lines = [doc.first for path in files for doc in docstrings(path) if in_package(path)]
        print(*random.Random(given.seed).sample(lines, given.draw), sep="\n")
        return 0
    findings = [finding for path in files for finding in check(path)]
    lengths = [length for path in files if path.suffix == ".md" for _, length in sentences(path)]
    mean = sum(lengths) / max(1, len(lengths))
    print(*findings, f"{len(findings)} findings in {len(files)} files", sep="\n")
    print(f"{len(lengths)} sentences in Markdown, {mean:.1f} words on average")
    return int(bool(findings) or mean > MAX_MEAN_SENTENCE)


def tracked(paths: list[str]) -> list[Path]:
    """Return the .py and .md files under `paths` that git knows or would add."""
    listing = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "--", *paths],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    found = (ROOT / name for name in listing.splitlines())
    return [f for f in found if f.suffix in (".py", ".md") and f.is_file()]


def in_package(path: Path) -> bool:
    """Return whether users of the installed package can meet the file's docstrings."""
    return path.suffix == ".py" and path.relative_to(ROOT).parts[0] != "tests"


def check(path: Path) -> list[Finding]:
    """Return what to reword in one file, in the order of its lines."""
    name = path.relative_to(ROOT).as_posix()
    read = python if path.suffix == ".py" else markdown
    findings = {
        Finding(name, line, word, fix)
        for line, word, fix in read(path)
        if (name, word.lower()) not in ALLOWED and (name, "*") not in ALLOWED
    }
    return sorted(findings, key=lambda f: (f.line, f.word))


def phrases(text: str, line: int) -> Iterator[tuple[int, str, str]]:
    """Yield the phrases of a text to replace; `line` is that of its first line."""
    # A phrase may cross a line's end, with the indentation or the `#` of the next line.
    flat = re.sub(r"[ \t]*\n[ \t]*#?[ \t]*", lambda m: "\n".ljust(len(m[0])), text)
    joined = re.sub(r"\s", " ", flat)
    for rule, fix in _PROSE:
        for match in rule.finditer(joined):
            yield line + flat.count("\n", 0, match.start()), match[0], fix


def identifier(name: str, line: int) -> Iterator[tuple[int, str, str]]:
    """Yield what is wrong with an identifier, read as the words that it joins."""
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|_+", " ", name)
    for rule, fix in _WORDS:
        if rule.search(words):
            yield line, name, fix


def python(path: Path) -> Iterator[tuple[int, str, str]]:
    """Yield what to reword in a Python file."""
    source = path.read_text()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield from phrases(token.string, token.start[0])
        elif token.type == tokenize.NAME:
            yield from identifier(token.string, token.start[0])
    for text, line in strings(ast.parse(source)):
        if re.search(r"\s", text.strip()):
            yield from phrases(text, line)
    for doc in docstrings(path):
        if match := OPENINGS.match(doc.first):
            fix = "a verb phrase (function) or a noun phrase (class, field)"
            yield doc.line, f"docstring opens with {match[0]}", fix
        elif len(doc.first.split()) < 2:
            yield doc.line, f"docstring says only {doc.first}", "a line that makes sense alone"
        elif not doc.first.endswith((".", ":", "?")):
            yield (
                doc.line,
                "docstring's first line ends amid a sentence",
                "one sentence on one line",
            )


def strings(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield every string of a syntax tree once, an f-string with its values as `0`."""
    parts = set()
    for node in ast.walk(tree):  # parents come first
        if isinstance(node, ast.JoinedStr):
            parts.update(map(id, node.values))
            values = [p.value if isinstance(p, ast.Constant) else "0" for p in node.values]
            yield "".join(map(str, values)), node.lineno
        elif isinstance(text := getattr(node, "value", None), str) and id(node) not in parts:
            yield text, node.lineno


@dataclass(frozen=True)
class Docstring:
    """The first line of a docstring, as a tooltip shows it."""

    first: str
    line: int


def docstrings(path: Path) -> Iterator[Docstring]:
    """Yield the docstrings of a Python file: of modules, classes, functions and fields."""
    if path.suffix != ".py":
        return
    for node in ast.walk(ast.parse(path.read_text())):
        body = getattr(node, "body", None)
        if not isinstance(node, _DEFINITIONS) or not isinstance(body, list):
            continue
        before = [None, *body]
        for previous, statement in zip(before, body, strict=False):
            documented = (
                isinstance(previous, ast.Assign | ast.AnnAssign) and isinstance(node, _HOLDERS)
            ) or previous is None
            text = statement.value if isinstance(statement, ast.Expr) else None
            if documented and isinstance(text, ast.Constant) and isinstance(text.value, str):
                lines = text.value.strip().splitlines() or [""]
                yield Docstring(lines[0].strip(), statement.lineno)


_HOLDERS = (ast.Module, ast.ClassDef)


def markdown(path: Path) -> Iterator[tuple[int, str, str]]:
    """Yield what to reword in a Markdown file, outside its code."""
    fenced = re.compile(r"^```.*?^```", re.M | re.S)
    text = fenced.sub(lambda m: "\n" * m[0].count("\n"), path.read_text())
    yield from phrases(re.sub(r"`[^`\n]*`", "`0`", text), 1)
    for line, length in sentences(path):
        if length > MAX_SENTENCE:
            yield line, f"sentence of {length} words", f"at most {MAX_SENTENCE}: split it"


def sentences(path: Path) -> Iterator[tuple[int, int]]:
    """Yield line and number of words of each sentence of a Markdown file."""
    text = re.sub(
        r"^```.*?^```", lambda m: "\n" * m[0].count("\n"), path.read_text(), flags=re.M | re.S
    )
    block: list[str] = []
    first = 1
    for number, line in enumerate([*text.splitlines(), ""], 1):
        begins = re.match(r"\s*(?:[-*+]|\d+\.)\s+", line)
        ends = not line.strip() or line.startswith(("    ", "|", "#", "!", "<", ">"))
        if begins or ends:
            yield from _sentences(" ".join(block), first)
            block = []
        if not ends or begins:
            first = first if block else number
            block.append(line[begins.end() :] if begins else line)


def _sentences(paragraph: str, line: int) -> Iterator[tuple[int, int]]:
    plain = re.sub(r"`[^`]*`", "0", paragraph)
    plain = re.sub(r"\]\([^)]*\)", "]", plain)
    for sentence in re.split(r"(?<=[.!?])[\])*_\"']*\s+(?=[\[(*_\"'A-Z0-9])", plain):
        if length := len(re.findall(r"\w[\w'.,/×-]*", sentence)):
            yield line, length


if __name__ == "__main__":
    sys.exit(main())
