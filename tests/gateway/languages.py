# ruff: noqa: E501 - a rule is a line
"""The examples for controllers, made Python: so much of each language as the examples use.

No controller is here. So the very files of ``examples/robots`` run in the tests: each is rewritten
line by line as Python, and what the controller brings (sockets, registers, motion) is a stub that
behaves as its manual says. A line that is not understood is an error.
"""

from __future__ import annotations

import re
from typing import NamedTuple

_WORDS = ((r"\bAND\b", "and"), (r"\bOR\b", "or"), (r"\bNOT\b", "not"), (r"<>", "!="))
_TRUTHS = ((r"\bTRUE\b", "True"), (r"\bFALSE\b", "False"))


class Block(NamedTuple):
    """A line that begins or ends a block.

    Attributes:
        pattern: what the whole line matches.
        text: the line of Python, "" for none.
        before: by how much it is indented less than the line before.
        after: by how much the next line is indented more.
    """

    pattern: str
    text: str = ""
    before: int = 0
    after: int = 0


def _words(text: str, *, equal: bool) -> str:
    """Rewrite words of conditions; ``equal``: a single = compares."""
    parts = re.split(r"('[^']*'|\"[^\"]*\")", text)  # texts stay
    for place in range(0, len(parts), 2):
        for pattern, word in (*_WORDS, *_TRUTHS):
            parts[place] = re.sub(pattern, word, parts[place])
        if equal:
            parts[place] = re.sub(r"(?<![<>!:=])=(?!=)", "==", parts[place])
    return "".join(parts)


def _rewrite(lines: list[str], blocks: list[Block], statement: object) -> str:
    """Return Python: lines that match a block as it says, others as ``statement`` says."""
    depth, out = 0, []
    for line in lines:
        for block in blocks:
            found = re.fullmatch(block.pattern, line)
            if found:
                depth -= block.before
                if block.text:
                    text = re.sub(r"\{(\w+)\}", lambda name: found[name[1]] or "", block.text)  # noqa: B023
                    out.append("    " * depth + text)
                depth += block.after
                break
        else:
            out += ["    " * depth + one for one in statement(line)]  # type: ignore[operator]
    assert depth == 0, "a block has no end"
    return "\n".join(out) + "\n"


# ---------------------------------------------------------------------- URScript


def from_urscript(source: str) -> str:
    """Return a script of Universal Robots as Python: blocks are indented there, too."""
    out = []
    for line in source.splitlines():
        bare = line.strip()
        if bare == "end":
            continue
        out.append(re.sub(r"^(\s*)local ", r"\1", line))
    return "\n".join(out) + "\n"


# ---------------------------------------------------------------------- KRL

_KRL = [
    Block(r"DEF (?P<n>\w+)\(\s*\)", "def {n}():", after=1),
    Block(r"DEF (?P<n>\w+)\((?P<a>\w+) :IN\)", "def {n}({a}):", after=1),
    Block(r"DEFFCT INT (?P<n>\w+)\((?P<a>\w+)\[\] :IN, (?P<b>\w+) :OUT\)", "def {n}({a}, {b}):", 0, 1),
    Block(r"END|ENDFCT", "", 1),
    Block(r"LOOP", "while True:", after=1),
    Block(r"ENDLOOP|ENDWHILE|ENDIF", "", 1),
    Block(r"IF (?P<c>.*) THEN", "if {c}:", after=1),
    Block(r"WHILE (?P<c>.*)", "while {c}:", after=1),
]  # fmt: skip


def from_krl(source: str) -> str:
    """Return a KRL module as Python; only what the example uses."""
    lines = [line.strip() for line in source.splitlines()]
    lines = [one for one in lines if one and one[0] not in ";&"]
    lines = [_krl_condition(one) if re.match("IF |WHILE ", one) else one for one in lines]
    return _rewrite(lines, _KRL, _krl_line)


def _krl_condition(text: str) -> str:
    return _words(text.replace("$", "_").replace("[]", ""), equal=False)


def _krl_line(line: str) -> list[str]:
    if found := re.fullmatch(r"DECL FRAME (\w+)", line):
        return [f"{found[1]} = locals().get('{found[1]}') or Frame()"]
    if line.startswith("DECL "):
        return []
    line = line.replace("[] ", " ").replace("[])", ")")
    if found := re.fullmatch(r"(RET) = (EKI_Get\w+)\((.*), ([\w.]+)\)", line):
        return [f"RET, {found[4]} = {found[2]}({found[3]}, {found[4]})"]
    if found := re.fullmatch(r"(\w+) = \$NULLFRAME", line):
        return [f"{found[1]} = Frame.null()"]
    if found := re.fullmatch(r"WAIT FOR (.*)", line):
        return [f"wait_for(lambda: {_krl_condition(found[1])})"]
    if found := re.fullmatch(r"WAIT SEC (.*)", line):
        return [f"sleep({found[1]})"]
    if found := re.fullmatch(r"(LIN|PTP) (\S+)", line):
        return [f"{found[1]}({found[2].replace('$', '_')})"]
    if found := re.fullmatch(r"BAS\(#(\w+), ([\d.]+)\)", line):
        return [f"BAS('{found[1]}', {found[2]})"]
    if found := re.fullmatch(r"RETURN (\w+)", line):
        return [f"return {found[1]}"]
    if found := re.fullmatch(r"(\w+) = part", line):
        return [f"{found[1]} = Frame(part)"]
    assert re.fullmatch(r"[$\w.]+(\[\d+\])? = [^=].*|\w+\(.*\)", line), line
    return [_krl_condition(line)]


# ---------------------------------------------------------------------- Karel

_OUTPUTS = {"MSG_CONNECT": 1, "MSG_DISCO": 1, "BYTES_AHEAD": 2, "GET_REG": 4, "CNV_STR_REAL": 1}
_OUTPUTS |= {"CNV_STR_CONF": 2, "SET_INT_REG": 1, "SET_POS_REG": 1}
"""Number of a built-in's arguments, the last ones, that come back."""

_KAREL = [
    Block(r"IF (?P<c>.*) THEN", "if {c}:", after=1),
    Block(r"ELSE", "else:", before=1, after=1),
    Block(r"WHILE (?P<c>.*) DO", "while {c}:", after=1),
    Block(r"FOR (?P<i>\w+) = (?P<a>\w+) TO (?P<b>.*) DO", "for {i} in range({a}, {b} + 1):", after=1),
    Block(r"ENDIF|ENDWHILE|ENDFOR", "", 1),
]  # fmt: skip


def from_karel(source: str) -> str:
    """Return a Karel program as Python: variables of the program are globals."""
    lines = [line.partition("--")[0].strip() for line in source.splitlines()]
    lines = [one for one in lines if one and one[0] != "%"]
    begin = lines.index("VAR")
    names = [one.partition(":")[0].strip() for one in _until(lines, begin + 1, "ROUTINE")]
    constants = _until(lines, lines.index("CONST") + 1, "VAR")
    rest = lines[begin + 1 + len(names) :]
    out, inside = [*constants, "values = Reals(8)"], False
    text: list[str] = []
    for line in rest:
        if found := re.fullmatch(r"ROUTINE (\w+)(?:\((\w+) : STRING\))?", line):
            text.append(f"@def {found[1]}({found[2] or ''})")
        elif re.fullmatch(r"VAR|\w+ : INTEGER", line):
            continue
        elif line == "BEGIN":
            inside = bool(text) and text[-1].startswith("@def")
            if not inside:
                text.append("@def smartcam()")
        else:
            text.append(line)
    blocks = [
        Block(r"@def (?P<n>\w+)\((?P<a>\w*)\)", "def {n}({a}):", after=1),
        Block(r"END (?P<n>\w+)", "", 1),
        *_KAREL,
    ]
    body = _rewrite([_words(one, equal=_compares(one)) for one in text], blocks, _karel_line)
    declared = f"    global {', '.join(names)}"
    body = re.sub(r"(def \w+\(.*\):)", lambda found: f"{found[1]}\n{declared}", body)
    return "\n".join(out) + "\n" + body


def _until(lines: list[str], begin: int, word: str) -> list[str]:
    end = next(i for i in range(begin, len(lines)) if lines[i].startswith(word))
    return lines[begin:end]


def _compares(line: str) -> bool:
    return line.startswith(("IF ", "WHILE "))


def _karel_line(line: str) -> list[str]:
    if found := re.fullmatch(r"(\w+)\((.*)\)", line):
        name, given = found[1], _arguments(found[2])
        count = _OUTPUTS.get(name, 0)
        if count:
            back = given[-count:]
            return [f"{', '.join(back)} = {name}({', '.join(given[:-count])})"]
        return [line]
    if found := re.fullmatch(r"READ (\w+) \((\w+)\)", line):
        return [f"{found[2]} = READ(128)"]
    if found := re.fullmatch(r"WRITE (\w+) \((.*)\)", line):
        return [f"WRITE({found[2]})"]
    if found := re.fullmatch(r"OPEN FILE (\w+) \((.*)\)", line):
        return [f"{found[1]} = OPEN_FILE({found[2]})"]
    if found := re.fullmatch(r"CLOSE FILE (\w+)", line):
        return ["CLOSE_FILE()"]
    if found := re.fullmatch(r"DELAY (\d+)", line):
        return [f"DELAY({found[1]})"]
    if re.fullmatch(r"[a-z_]+", line):
        return [f"{line}()"]
    found = re.fullmatch(r"([\w\[\]]+) = (.*)", line)
    assert found, line
    return [f"{found[1]} = {_words(found[2], equal=True)}"]


def _arguments(text: str) -> list[str]:
    """Split at commas that are in no brackets."""
    out, depth = [""], 0
    for one in text:
        depth += (one in "([") - (one in ")]")
        if one == "," and depth == 0:
            out.append("")
        else:
            out[-1] += one
    return [one.strip() for one in out]


# ---------------------------------------------------------------------- SCL

_SCL = [
    Block(r"IF (?P<c>.*) THEN", "if {c}:", after=1),
    Block(r"ELSIF (?P<c>.*) THEN", "elif {c}:", 1, 1),
    Block(r"ELSE", "else:", 1, 1),
    Block(r"FOR (?P<i>\S+) := (?P<a>\S+) TO (?P<b>\S+) DO", "for {i} in range({a}, {b} + 1):", 0, 1),
    Block(r"END_IF|END_FOR", "", 1),
    Block(r"CASE (?P<c>\S+) OF", "_case = {c}", 0, 0),
    Block(r"@(?P<n>\d+)", "if _case == {n}:", 0, 1),
    Block(r"@first (?P<n>\d+)", "if _case == {n}:", 0, 1),
    Block(r"@next (?P<n>\d+)", "if _case == {n}:", 1, 1),
    Block(r"END_CASE", "", 1),
]  # fmt: skip


def from_scl(source: str) -> str:
    """Return the cycle of a function block as Python: a function ``cycle(s)`` of its instance."""
    body = source.partition("\nBEGIN\n")[2].partition("END_FUNCTION_BLOCK")[0]
    body = "\n".join(line.partition("//")[0] for line in body.splitlines())
    body = re.sub(r"T#(\d+)S", r"\1.0", body)
    body = re.sub(r"#(\w+)", r"s.\1", body)
    pieces = re.split(r";|(?<=\bTHEN)\s|(?<=\bELSE)\s|(?<=\bDO)\s|(?<=\bOF)\s|(?<=\d:)\s", body)
    lines: list[str] = []
    first = True
    for piece in pieces:
        line = " ".join(piece.split())
        if found := re.fullmatch(r"(\d+):", line):
            line, first = f"@{'first' if first else 'next'} {found[1]}", False
        if line:
            head = line.startswith(("IF ", "ELSIF "))
            lines.append(_words(line.replace("'$R'", r"'\r'").replace("'$L'", r"'\n'"), equal=head))
    text = _rewrite(lines, _SCL, _scl_line)
    return "def cycle(s):\n" + "".join(f"    {line}\n" for line in text.splitlines())


def _scl_line(line: str) -> list[str]:
    if found := re.fullmatch(r"(s\.\w+)\((.*)\)", line):
        given = []
        for one in _arguments(found[2]):
            name, _, value = one.partition(" := ")
            given.append(f"{name}={_words(value, equal=True)}")
        return [f"{found[1]}({', '.join(given)})"]
    found = re.fullmatch(r"(s\.\w+(?:\[.*?\])?) := (.*)", line)
    assert found, line
    return [f"{found[1]} = {_words(found[2], equal=True)}"]
