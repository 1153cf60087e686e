"""Names and words as other programs take them: checked where they enter, escaped where they leave.

HTML is escaped by its templates, LaTeX in `study.report.tables`, and a shell's words by shlex.
"""

import re

_ID = re.compile(r"[\w./:-]+")
_MARKS = re.compile(r"[\\`*|<>]|(?<=\])\(")


def check_id(value: str) -> str:
    """The id of a task or an algorithm, which is letters, digits and . / : - _; or a ValueError."""
    if not _ID.fullmatch(value):
        raise ValueError("must be letters, digits and . / : - _, such as HalfCheetah-v5")
    return value


def printable(text: str) -> str:
    r"""The text in one line; control characters and lone surrogates as escapes, such as \x1b."""
    if text.isprintable():
        return text
    return "".join(x if x.isprintable() else x.encode("unicode_escape").decode() for x in text)


def markdown(text: str) -> str:
    """The text as Markdown shows it, without marks that would be a table, a link or HTML."""
    return _MARKS.sub(lambda found: f"\\{found[0]}", printable(text))
