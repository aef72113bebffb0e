"""The rule on English: plain words, imperative first lines, and no text about the place where the project is written.

``python tests/test_english.py [PATH ...]`` prints every hit under the given paths and the count of hits in each folder.
"""

from __future__ import annotations

import ast
import io
import re
import shutil
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

TOP = Path(__file__).parent.parent
MOST_WORDS = 12
"""Words that the first line of a function's docstring may have; shapes and units in parentheses are not counted."""

FORBIDDEN = {
    "says, shows, reports or states instead of 'tell'": r"\b(tell|tells|telling|told)\b",
    "is or lies instead of 'stand'": r"\b(stand|stands|standing|stood)\b(?!-|\s+(still|for|out|in\s+for)\b)",
    "a plain word instead of 'at hand'": r"\bat\s+hand\b",
    "depends on instead of 'hangs on'": r"\bhangs?\s+on\b",
    "can be reached or exists instead of 'be had'": r"\bbe\s+had\b",
    "name the actor instead of 'whoever'": r"\b(whoever|whomever)\b",
    "name the thing instead of 'what is such'": r"\bwhat\s+is\s+such\b",
    "whose, or two sentences, instead of 'of whom'": r"\bof\s+whom\b",
    "name the thing instead of 'what was found'": r"\bwhat\s+(was|were)\s+(found|seen|kept|asked|made|taken)\b",
    "name the thing instead of 'the one that'": r"\bthe\s+ones?\s+that\b",
    "whether instead of 'whether or not'": r"\bwhether\s+or\s+not\b",
    "name the state instead of 'as it is'": r"\bas\s+it\s+is(?=\s*[.,;:)]|\s*$)",
}
"""What to write instead -> the words that are not written, in any case."""

# Brackets inside the words keep this file from finding itself.
WORKPLACE = {
    "a path of one machine": r"/wor[k]/|/tmp/w[t]\b|\.\./share[d]|\bworktre[e]s?\b",
    "a document that is no part of the project": r"\b(SCIENC[E]|DESIG[N]|STYL[E]|AP[I])\.md\b|\bprototype[s]/",
    "who typed the text": r"(?i:\bclaud[e]\b|\banthropi[c]\b|\bsub-?agen[t]s?\b|\blanguage mode[l]\b)",
    "the host of a package registry": r"(?i:\bpypi\.or[g]|\bpythonhosted\.or[g]|\bregistry\.npmj[s])",
}

_VERBS = """
accept adapt add adjust advance align allow announce answer append apply approximate ask assemble assert assign associate attach
average avoid back-project batch begin bend bind blend block blur bound branch bring build bundle calculate calibrate call cancel
carry centre change check choose claim classify clean clear clip close collect colour combine compare compile complete
compose compress compute configure confirm connect constrain construct continue convert convolve copy correct count cover
create crop cut damp decide declare decode decompose decompress decrease define delete deliver demand deny derive describe
detect determine diffuse dilate disable discard discover display displace distinguish distribute divide do double draw drive
drop dump eliminate embed emit empty enable encode encrypt end enforce enlarge enqueue ensure enter enumerate erode escape
estimate evaluate examine exchange exclude execute exit expand expect explain export express extend extract extrapolate
factorise fail feed fetch fill filter finalise find finish fit fix flag flatten flip fold follow forbid forget format
forward free freeze fuse gate gather generate get give grade grey group grow guard halve handle hand hash hide hold
identify ignore imitate import include increase index infer inform initialise insert inspect install integrate interpolate
interrupt intersect introduce invert issue iterate join judge keep kill label launch leave lengthen let lift limit linearise
link list listen load locate lock log look lower maintain make manage map mark mask match measure merge migrate minimise mirror
mix modify monitor move multiply name narrow normalise note notify obtain offer omit open order orient overlay override overwrite
pack pad paint pair parse pass patch pause perform perturb pick place plan plot populate post predict prefer prepare
prevent print process produce project promote propagate propose protect prove provide prune publish pull push put query
queue quote raise randomise rank read reap rebuild receive recognise recompute reconstruct record recover redirect redo
reduce refine reflect refuse register reject release reload remember remove rename render renew reorder repair repeat
replace report represent reproduce request require resample rescale reserve reset reshape resize resolve respond restart
restore restrict resume retrieve retry return reuse reverse revoke rewrite rotate round run sample satisfy save say scale
scan schedule score search seed segment select send separate serialise serve set settle shift shorten show shrink shut sign
simplify simulate skip slice smooth snap solve sort split spread square stack start state step stop store stream stretch
strip subdivide subscribe subtract suggest sum summarise supply suppress surround suspend swap sweep switch synthesise take
terminate test threshold throw tile touch trace track train transfer transform translate transpose traverse triangulate trim
try turn undo unfold unlink unlock unpack update upgrade upload use validate verify visit wait wake walk warm warn warp
watch weigh widen withdraw wrap write yield zoom
"""
VERBS = frozenset(_VERBS.split())
"""Verbs that may open the docstring of a function."""


@dataclass(frozen=True, slots=True)
class Hit:
    """A place that breaks a rule."""

    path: str
    line: int
    rule: str
    text: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.rule}: {self.text}"


@dataclass(frozen=True, slots=True)
class Passage:
    """Text that a reader sees, and the line where it begins."""

    line: int
    text: str


def tracked(*patterns: str) -> list[str]:
    """Return the project's own files that match a pattern."""
    git = shutil.which("git")
    if git is not None and (TOP / ".git").exists():
        list_files = [git, "ls-files", "-co", "--exclude-standard"]
        names = subprocess.run(list_files, cwd=TOP, capture_output=True, text=True, check=True).stdout.splitlines()
    else:
        names = [str(path.relative_to(TOP)) for path in TOP.rglob("*") if path.is_file() and ".venv" not in path.parts]
    own = [name for name in names if "/web/assets/three/" not in name and (TOP / name).exists()]
    return sorted(name for name in own if any(Path(name).match(pattern) for pattern in patterns))


PYTHON = tracked("*.py")
PAGES = tracked("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md")
PLAIN = tracked("run", ".ci/run", "Dockerfile", "docker-compose.yml", "pyproject.toml", "*.j2", "*.mako")
LOCKS = tracked("*.lock")


def passages(name: str) -> Iterator[Passage]:
    """Yield the text of a file that a reader sees.

    In Python files these are docstrings, comments and sentences; in other files everything.
    """
    text = (TOP / name).read_text()
    if name.endswith(".py"):
        yield from docstrings(ast.parse(text))
        yield from comments(text)
        yield from sentences(ast.parse(text), only_raised=name.startswith("tests/"))
    elif name.endswith(".md"):
        # Blocks of commands and code keep their lines, so that the numbers stay true.
        yield Passage(1, re.sub(r"^```.*?^```", lambda block: "\n" * block[0].count("\n"), text, flags=re.M | re.S))
    else:
        yield Passage(1, text)


def docstrings(tree: ast.Module) -> Iterator[Passage]:
    """Yield docstrings of modules, classes, functions and constants."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield Passage(node.lineno, node.value.value)


def comments(text: str) -> Iterator[Passage]:
    """Yield comments, with neighbouring lines joined.

    So a phrase that runs across two lines is found.
    """
    start, last, joined = 0, 0, ""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type != tokenize.COMMENT:
            continue
        line = token.start[0]
        if joined and line == last + 1:
            joined += "\n" + token.string.lstrip("# ")
        else:
            if joined:
                yield Passage(start, joined)
            start, joined = line, token.string.lstrip("#! ")
        last = line
    if joined:
        yield Passage(start, joined)


def sentences(tree: ast.Module, *, only_raised: bool) -> Iterator[Passage]:
    """Yield literals of three words or more.

    These are messages, descriptions and help; in tests only those of ``raise``.
    """
    inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    shown = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    roots = [node for node in ast.walk(tree) if isinstance(node, ast.Raise)] if only_raised else [tree]
    for node in (child for root in roots for child in ast.walk(root)):
        if id(node) in inside or id(node) in shown:
            continue
        if isinstance(node, ast.JoinedStr):
            parts = (part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
            text = "".join(str(part) for part in parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
        else:
            continue
        if len(text.split()) >= 3:
            yield Passage(node.lineno, text)


def forbidden_words(name: str) -> list[Hit]:
    """Return the places of a file with words from the list."""
    return _found(name, passages(name), FORBIDDEN, re.IGNORECASE)


def workplace_words(name: str) -> list[Hit]:
    """Return the places of a file that break ``WORKPLACE``."""
    return _found(name, [Passage(1, (TOP / name).read_text())], WORKPLACE, 0)


def _found(name: str, shown: Iterable[Passage], rules: dict[str, str], flags: int) -> list[Hit]:
    hits = set()
    for passage in shown:
        for rule, pattern in rules.items():
            for match in re.finditer(pattern, passage.text, flags):
                line = passage.line + passage.text.count("\n", 0, match.start())
                around = passage.text[max(match.start() - 30, 0) : match.end() + 30]
                hits.add(Hit(name, line, rule, " ".join(around.split())))
    return sorted(hits, key=lambda hit: (hit.line, hit.rule))


def first_lines(name: str) -> list[Hit]:
    """Return the functions whose docstrings open wrongly.

    The first line opens with a verb and has at most ``MOST_WORDS`` words.
    """
    return list(_first_lines(name, ast.parse((TOP / name).read_text())))


def _first_lines(name: str, tree: ast.AST) -> Iterator[Hit]:
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from _first_lines(name, node)
            continue
        # Functions inside functions are not visited: they explain themselves where they are used.
        text = ast.get_docstring(node)
        if text is None or _is_exempt(node):
            continue
        line = text.splitlines()[0]
        problem = _wrong_first_line(line)
        if problem is not None:
            yield Hit(name, node.lineno, problem, f"{node.name}: {line[:70]}")


def _is_exempt(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    decorators = " ".join(ast.unparse(decorator) for decorator in node.decorator_list)
    named = node.name.startswith(("test_", "__"))
    return named or re.search(r"property|\.setter|fixture|overload", decorators) is not None


def _wrong_first_line(line: str) -> str | None:
    counted = re.sub(r"\([^()]*\)|\b([Aa]n?|the)\b", "", line)
    words = [word for word in counted.split() if re.search(r"\w", word)]
    verb = re.sub(r"[^\w-]", "", words[0]).lower() if words else ""
    if verb not in VERBS or (len(words) > 1 and words[1] == "of"):
        return "open with an imperative verb"
    if len(words) > MOST_WORDS:
        return f"{len(words)} words; at most {MOST_WORDS}"
    return None


@pytest.mark.parametrize("name", [*PYTHON, *PAGES, *PLAIN])
def test_words_are_plain(name: str) -> None:
    hits = forbidden_words(name)
    assert not hits, "\n" + "\n".join(map(str, hits))


@pytest.mark.parametrize("name", PYTHON)
def test_first_line_of_a_docstring_is_an_imperative(name: str) -> None:
    hits = first_lines(name)
    assert not hits, "\n" + "\n".join(map(str, hits))


@pytest.mark.parametrize("name", [*PYTHON, *PAGES, *PLAIN, *LOCKS])
def test_text_is_about_the_project(name: str) -> None:
    hits = workplace_words(name)
    assert not hits, "\n" + "\n".join(map(str, hits))


def test_rule_knows_its_words_and_lets_others_pass() -> None:
    def caught(text: str) -> bool:
        return bool(_found("x", [Passage(1, text)], FORBIDDEN, re.IGNORECASE))

    for wrong in (
        "The header tells nothing.", "as the file\ntold it", "where the site stands", "It stood there.", "all at\nhand",
        "what hangs on it", "no depth can be had", "Whoever holds one", "what is such already", "of whom none",
        "what was found instead", "the one that fits", "whether or not it fits", "It is taken as it is.",
    ):  # fmt: skip
        assert caught(wrong), wrong
    for right in (
        "a stand-in", "the standard deviation", "an understood outstanding case", "It stands still.", "It stands for the wall.",
        "a beforehand check", "It hangs.", "as it is computed", "what one view shows", "a toldo",
    ):  # fmt: skip
        assert not caught(right), right


def test_rule_on_first_lines_lets_only_short_imperatives_pass() -> None:
    assert _wrong_first_line("Return the rays of the electrodes.") is None
    assert _wrong_first_line("Back-project pixels to a depth.") is None
    # Shapes in brackets and articles do not count.
    long = "Return the covariances (..., 4 N, 4 N) in mm of all the points that both views show at the same phase."
    assert _wrong_first_line(long) is not None
    assert _wrong_first_line("Return the covariances (..., 4 N, 4 N) of the points that both views show.") is None
    for wrong in ("The rays.", "Returns the rays.", "Score of a path.", "Return " + "more " * 12, ""):
        assert _wrong_first_line(wrong) is not None, wrong


def _under(name: str, paths: list[str]) -> bool:
    return not paths or any((TOP / name).resolve().is_relative_to(Path(path).resolve()) for path in paths)


def main(paths: list[str]) -> int:
    """Print the hits under the paths and their count in each folder."""
    counts: Counter[tuple[str, str]] = Counter()
    for rule, check, names in (
        ("words", forbidden_words, [*PYTHON, *PAGES, *PLAIN]),
        ("first lines", first_lines, PYTHON),
        ("workplace", workplace_words, [*PYTHON, *PAGES, *PLAIN, *LOCKS]),
    ):
        for name in names:
            if not _under(name, paths):
                continue
            hits = check(name)
            print(*hits, sep="\n", end="\n" if hits else "")
            counts["/".join(Path(name).parts[:-1][:3]) or ".", rule] += len(hits)
    for (folder, rule), count in sorted(counts.items()):
        if count:
            print(f"{count:5} {rule:12} {folder}")
    return int(any(counts.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
