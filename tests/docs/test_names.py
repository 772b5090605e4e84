"""Every command, option, setting, metric, path and link in the documents exists."""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from ruamel.yaml import YAML

import tom
from app.__main__ import _parser as studio_parser
from tom.cli import COMMANDS, build_parser
from tom.cli.parser import leaf_fields
from tom.config import OnlineConfig, RoadConfig
from tom.metrics import METRICS

ROOT = Path(__file__).parents[2]
TOP = ("README.md", "CONTRIBUTING.md", "runs/README.md")  # the changelog names what was, too
PAGES = [*(ROOT / name for name in TOP), *sorted((ROOT / "docs").rglob("*.md"))]
CODE = re.compile(r"```[a-z]*\n(.*?)```|`([^`\n]+)`", re.DOTALL)
COMMAND = re.compile(r"(?:^|[\s/&(])tom ((?:[a-z][\w-]*)(?:[^\n`;|&)]*))")
LINK = re.compile(r"\]\(([^)#\s]+)\)")
ANCHOR = re.compile(r"\]\(([^)#\s]*)#([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
PLACE = re.compile(r"(?:tom|app|tests|docs|\.ci)/[\w./-]*[\w/]")
SETTING = re.compile(r"(?:tom|pmac|vagram|sac|model|rollout|evaluation)\.[a-z_]+(?==|$)")
METRIC = re.compile(r"(?:weights|dual|discriminator|model|exam|eval|planner)/[a-z_]+")
FROM_PYTHON = {f"tom.{name}" for name in dir(tom)}
EXAMPLES = {"docs/extend.md"}  # names files that do not exist yet: test_extend makes them


def inline(page: Path) -> Iterator[str]:
    return (text for _, text in CODE.findall(page.read_text()) if text)


def code(page: Path) -> Iterator[str]:
    for block, text in CODE.findall(page.read_text()):
        yield (block or text).replace("\\\n", " ")


def commands() -> Iterator[tuple[Path, str]]:
    for page in PAGES:
        for text in code(page):
            for line in text.splitlines():
                for found in COMMAND.findall(line.split(" #")[0]):
                    yield page, found.strip()


def sub(parser: argparse.ArgumentParser, word: str) -> argparse.ArgumentParser | None:
    """The parser of the subcommand `word`; None where `parser` has no subcommands."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            assert word in action.choices, f"no such command: {word}"
            return action.choices[word]
    return None


def check(command: str) -> None:
    """The command's words and options are known; values may be placeholders."""
    words = command.replace("[", " ").replace("]", " ").split()
    parser = build_parser(words)
    if words[0] == "studio":
        parser, words = studio_parser(), words[1:]
    while words and re.fullmatch(r"[a-z][a-z-]*", words[0]):
        below = sub(parser, words[0])
        if below is None:
            break
        parser, words = below, words[1:]
    known = {option for action in parser._actions for option in action.option_strings}
    for word in words:
        option = word.split("=")[0].rstrip(",")
        if option.startswith("--"):
            assert option in known, f"{parser.prog} has no {option}"


@pytest.mark.parametrize(
    ("page", "command"),
    sorted(set(commands())),
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_every_command_exists(page: Path, command: str):
    check(command)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page: Path):
    for link in LINK.findall(page.read_text()):
        if "://" not in link:
            assert (page.parent / link).exists(), f"{page.name}: {link}"


def anchor(heading: str) -> str:
    """Where a heading is found, as GitHub names it: lower case, hyphens for spaces."""
    return re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_anchor_exists(page: Path):
    for link, name in ANCHOR.findall(page.read_text()):
        if "://" not in link:
            target = (page.parent / link).read_text() if link else page.read_text()
            assert name in map(anchor, HEADING.findall(target)), f"{page.name}: {link}#{name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_path_exists(page: Path):
    if str(page.relative_to(ROOT)) in EXAMPLES:
        return
    for text in code(page):
        for place in PLACE.findall(text):
            assert (ROOT / place).exists(), f"{page.name}: {place}"


def options(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Every option of a parser and of all its subcommands."""
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from options(below)


def test_every_option_setting_and_metric_exists():
    road = ["train", "--env", "road-and-rocks"]
    known = {
        *options(build_parser(road)),
        *options(build_parser([*COMMANDS])),
        *options(studio_parser()),
    }
    settings = {path for config in (OnlineConfig, RoadConfig) for path, _ in leaf_fields(config)}
    seen = set()
    for page in PAGES:
        for text in inline(page):
            if text.startswith("--"):
                assert text.split()[0].split("=")[0] in known, f"{page.name}: {text}"
                seen.add("option")
            elif (found := SETTING.match(text)) and text not in FROM_PYTHON:
                assert found[0] in settings, f"{page.name}: {text}"
                seen.add("setting")
            elif METRIC.fullmatch(text):
                assert text in METRICS, f"{page.name}: {text}"
                seen.add("metric")
    assert seen == {"option", "setting", "metric"}


def test_the_commands_are_really_found():
    found = {command.split()[0] for _, command in commands()}
    assert {"train", "studio", "sweep", "runs", "reproduce", "demo", "doctor"} <= found


def test_the_citation_file_is_of_this_version():
    cited = YAML(typ="safe", pure=True).load((ROOT / "CITATION.cff").read_text())
    assert f'version = "{cited["version"]}"' in (ROOT / "pyproject.toml").read_text()
    assert cited["license"] == "MIT"
