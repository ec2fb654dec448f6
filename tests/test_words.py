"""Words of the package: how a docstring begins, one constant a line, its name and its comment."""

import ast
import io
import re
import tokenize

import pytest
from architecture import MODULES, ROOT, room_of

CLAUSES = {"What", "Where", "Whether", "Which", "Who", "Whose", "How", "So", "Such"}
LONGEST_THAT = 12  # words of a first sentence "The ... that ..."
VAGUE = re.compile(r"\bso (many|far|often|long)\b", re.IGNORECASE)
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")
SUPERLATIVE = re.compile(r"_?(MOST|LEAST|LONGEST|SHORTEST|LARGEST|SMALLEST|FEWEST|FARTHEST|NEAREST|ENOUGH)(_|$)")


def docstrings(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), " ".join(text.split("\n\n")[0].split())


def is_clause(docstring):
    """True if a docstring begins with a relative clause, or with a long "The ... that ..."."""
    words = re.split(r"(?<=[.:;])\s", docstring)[0].split()
    return words[0].strip(",:;") in CLAUSES or (words[0] == "The" and "that" in words and len(words) > LONGEST_THAT)


def constants(tree):
    """Assignments to names of constants, at module and class level."""
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    for node in [*tree.body, *(one for each in classes for one in each.body)]:
        targets = (
            [node.target] if isinstance(node, ast.AnnAssign) else node.targets if isinstance(node, ast.Assign) else []
        )
        names = [
            name.id for target in targets for name in getattr(target, "elts", [target]) if isinstance(name, ast.Name)
        ]
        if names and all(CONSTANT.fullmatch(name) for name in names):
            yield node, names


def comments(text):
    return {
        token.start[0]: token.string
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type == tokenize.COMMENT
    }


def faults(text):
    """All that is wrong with the words of a module, as (line, what)."""
    tree, said = ast.parse(text), comments(text)
    found = [(line, f"begins with a clause: {words}") for line, words in docstrings(tree) if is_clause(words)]
    for node, names in constants(tree):
        if len(names) > 1:
            found.append((node.lineno, f"{', '.join(names)} in one line"))
        found += [(node.lineno, f"{name}: call it MIN_ or MAX_") for name in names if SUPERLATIVE.match(name)]
        above = node.lineno - 1
        while above in said and said[above].startswith("#:"):
            above -= 1
        vague = [(line, VAGUE.search(said.get(line, ""))) for line in range(above + 1, node.end_lineno + 1)]
        found += [(line, f"says {match[0]!r} of a constant") for line, match in vague if match]
    return found


@pytest.mark.parametrize("room", sorted({room_of(module) for module in MODULES}))
def test_words_of_a_room(room):
    wrong = [
        f"{path.relative_to(ROOT)}, line {line}: {what}"
        for module, path in MODULES.items()
        if room_of(module) == room
        for line, what in faults(path.read_text(encoding="utf-8"))
    ]
    assert not wrong, "\n".join(wrong)


def test_faults_of_words_are_found():
    text = '"""Which way."""\n#: So many\nA, B = 1, 2\nC = 3  # so far [m]\nMOST = 4\n\n\ndef f():\n    """Add."""\n'
    assert [line for line, _ in faults(text)] == [1, 3, 2, 4, 5]
    assert is_clause("The distance of two robots that have both seen the same markers for some time, in metres.")
    assert not is_clause("The robots that move.") and not is_clause("Whereabouts of a robot.")
