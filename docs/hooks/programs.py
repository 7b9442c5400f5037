"""Command lines of the programs: their parsers, and the reference pages made from them."""

import argparse
from collections.abc import Iterator, Mapping
from importlib import import_module

from vram_arbiter.arbiter.__main__ import parser as arbiter_parser
from vram_arbiter.arbiter.offline.__main__ import parser as event_log_parser
from vram_arbiter.clients.cli.installation.completion import whole_parser
from vram_arbiter.clients.observer.__main__ import parser as observer_parser
from vram_arbiter.reasoner.options import parser as reasoner_parser
from vram_arbiter.runner.__main__ import parser as runner_parser
from vram_arbiter.sidecars.__main__ import parser as sidecar_parser
from vram_arbiter.sidecars.gateway.__main__ import parser as gateway_parser

EVERYWHERE = ("-h", "--version")  # options of every command, which its table leaves out


def vramctl() -> argparse.ArgumentParser:
    """Return one parser of all commands, with those that the arbiter's own program parses."""
    made = whole_parser()
    (commands,) = (one for one in made._actions if isinstance(one, argparse._SubParsersAction))
    offline = subcommands(event_log_parser())
    commands.choices.update({name: offline[name] for name in commands.choices if name in offline})
    return made


def parsers() -> Mapping[str, argparse.ArgumentParser]:
    """Return the parser of each program by its name."""
    reasoner = import_module("vram_arbiter.reasoner.__main__").__doc__
    return {
        "vramctl": vramctl(),
        "vram-arbiter": arbiter_parser(),
        "vram-observer": observer_parser(),
        "vram-sidecar": sidecar_parser(),
        "vram-gateway": gateway_parser(),
        "vram-runner": runner_parser(),
        "vram-reasoner": reasoner_parser(reasoner),
    }


def subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the commands of a parser, none where it has none."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def page(program: str) -> str:
    """Return the Markdown of one program's options and commands, without the page's title."""
    parser = parsers()[program]
    return "\n\n".join([*_described(parser), *_commands(program, parser, "##")])


def _commands(program: str, parser: argparse.ArgumentParser, level: str) -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            helps = {choice.dest: choice.help for choice in action._choices_actions}
            for name, command in action.choices.items():
                yield f"{level} {program} {name}"
                yield from _described(command, default=helps.get(name) or "")
                yield from _commands(f"{program} {name}", command, level + "#")


def _described(parser: argparse.ArgumentParser, default: str = "") -> Iterator[str]:
    yield _sentence(parser.description or default)
    usage = parser.format_usage().removeprefix("usage: ").rstrip()
    yield f"```text\n{usage}\n```"
    rows = list(_rows(parser))
    if rows:
        yield "\n".join(["| argument | meaning |", "| --- | --- |", *rows])
    if parser.epilog:
        yield f"```text\n{parser.epilog.rstrip()}\n```"


def _rows(parser: argparse.ArgumentParser) -> Iterator[str]:
    formatter = parser._get_formatter()
    for action in parser._actions:
        hidden = action.help is argparse.SUPPRESS or set(action.option_strings) & set(EVERYWHERE)
        if hidden or isinstance(action, argparse._SubParsersAction):
            continue
        names = ", ".join(action.option_strings) or str(action.metavar or action.dest)
        value = ""
        if action.option_strings and action.nargs != 0:
            default = formatter._get_default_metavar_for_optional(action)
            value = " " + formatter._format_args(action, default)
        meaning = formatter._expand_help(action) if action.help else ""
        yield f"| `{_cell(names + value)}` | {_cell(meaning)} |"


def _sentence(text: str) -> str:
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "\n")) else ".")


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
