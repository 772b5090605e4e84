"""A user's labels of a run: `labels.json`, the only file that the training does not write."""

from dataclasses import asdict, dataclass
from typing import Any

from tom.errors import UserError

SCHEMA = 1
NAME_LENGTH = 80
TAG_LENGTH = 30
NOTE_LENGTH = 4000
MOST_TAGS = 20


@dataclass(frozen=True)
class Labels:
    """A display name, tags in order, and a note of several lines; all plain text, may be empty."""

    name: str = ""
    tags: tuple[str, ...] = ()
    note: str = ""

    def record(self) -> dict[str, Any]:
        """The content of `labels.json`."""
        return {"schema": SCHEMA, **asdict(self)}


def parse(content: dict[str, Any]) -> Labels:
    """The labels in a JSON object."""
    return Labels(content.get("name", ""), tuple(content.get("tags", ())), content.get("note", ""))


def checked(labels: Labels) -> Labels:
    """`labels` in normal form. Raises UserError if a text is too long or not plain."""
    tags = dict.fromkeys(_line("tag", tag, TAG_LENGTH) for tag in labels.tags)
    if "" in tags:
        raise UserError("a tag cannot be empty")
    if len(tags) > MOST_TAGS:
        raise UserError(f"{len(tags)} tags are too many: {MOST_TAGS} at most")
    return Labels(_line("name", labels.name, NAME_LENGTH), tuple(tags), _text(labels.note))


def _line(kind: str, text: str, length: int) -> str:
    if not text.isprintable():
        raise UserError(f"a {kind} is one line of plain text, not {text!r:.60}")
    return _short(kind, text.strip(), length)


def _text(text: str) -> str:
    if not all(line.isprintable() for line in text.split("\n")):
        raise UserError("a note is plain text, without control characters")
    return _short("note", text.strip(), NOTE_LENGTH)


def _short(kind: str, text: str, length: int) -> str:
    if len(text) > length:
        raise UserError(f"a {kind} of {len(text)} characters is too long: {length} at most")
    return text
