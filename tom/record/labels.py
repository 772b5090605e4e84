"""A user's labels of a run: `labels.json`, the only file that the training does not write."""

from dataclasses import dataclass
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


def parse(content: dict[str, Any]) -> Labels:
    """The labels in a JSON object."""
    return Labels(content.get("name", ""), tuple(content.get("tags", ())), content.get("note", ""))


def checked(labels: Labels) -> Labels:
    """`labels` in normal form. Raises UserError if a text is too long or not plain."""
    tags = dict.fromkeys(_plain("tag", tag, TAG_LENGTH) for tag in labels.tags)
    if "" in tags:
        raise UserError("a tag cannot be empty")
    if len(tags) > MOST_TAGS:
        raise UserError(f"{len(tags)} tags are too many: {MOST_TAGS} at most")
    name = _plain("name", labels.name, NAME_LENGTH)
    return Labels(name, tuple(tags), _plain("note", labels.note, NOTE_LENGTH, lines=True))


def _plain(kind: str, text: str, length: int, *, lines: bool = False) -> str:
    """The text without white space around it."""
    if not (text.replace("\n", "") if lines else text).isprintable():
        raise UserError(
            f"a {kind} is plain text{'' if lines else ' of one line'}, not {text!r:.60}"
        )
    if len(text.strip()) > length:
        raise UserError(f"a {kind} of {len(text)} characters is too long: {length} at most")
    return text.strip()
