"""Code on the pages is true: commands and flags exist in the programs' parsers, Python compiles and
imports what exists, YAML is what our models accept, JSON is JSON. The site is built of these pages,
at night and by `make docs`.
"""

import argparse
import ast
import contextlib
import functools
import io
import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from docs.hooks.programs import parsers, subcommands
from tests.packaging.test_pages import PAGES
from tests.support.deployment import load_robot
from tests.support.paths import ROOT
from vram_arbiter.schemas.config.arbiter import load_config
from vram_arbiter.schemas.config.gateway import load_gateway, load_keys
from vram_arbiter.schemas.config.observer import load_observer
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.manifest.load import parse_manifest
from vram_arbiter.testing.scenario import load_scenario

HISTORY = "CHANGELOG.md"  # speaks of the past
LANGUAGES = {"console", "ini", "json", "python", "sh", "text", "yaml"}
FENCE = re.compile(r"^```(.*)\n((?:.*\n)*?)```$", re.MULTILINE)
INLINE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
ENDS = {";", "&", "&&", "|", "||", "(", ")", ">", ">>", "<", "2>"}  # of one command in a line
SITE_LIMIT_S = 240.0


class Block(NamedTuple):
    """One fenced block of a page."""

    page: Path
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}: {self.text.splitlines()[0]}"


def blocks() -> Iterator[Block]:
    for page in PAGES:
        if page.name != HISTORY:
            for language, text in FENCE.findall(page.read_text(encoding="utf-8")):
                yield Block(page, language, text)


BLOCKS = list(blocks())
programs = functools.cache(parsers)
EXTRA = re.compile(r"(?:vram-arbiter|'\.)\[([\w,-]+)\]")
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


def of(language: str) -> list[Block]:
    return [block for block in BLOCKS if block.language == language]


def test_every_block_names_its_language() -> None:
    assert [str(block) for block in BLOCKS if block.language not in LANGUAGES] == []


# -- commands --------------------------------------------------------------------------------------
def commands(text: str) -> Iterator[list[str]]:
    """Split lines of a shell into the words of each command."""
    for line in text.replace("\\\n", " ").splitlines():
        try:
            words = shlex.shlex(line, posix=True, punctuation_chars=True)
            words.commenters = "#"
            words.whitespace_split = True
            found = list(words)
        except ValueError:  # a text of several lines in quotes, such as a program for `python -c`
            continue
        command: list[str] = []
        for word in [*found, ";"]:
            if word in ENDS:
                yield command
                command = []
            else:
                command.append(word)


PROMPTS = {"sh": r"^(.*)$", "console": r"^\$ (.*)$", "ini": r"^ExecStart=(.*)$"}


def typed() -> Iterator[tuple[Block, list[str]]]:
    """Every command of every block that a shell or a service manager reads."""
    for block in BLOCKS:
        if prompt := PROMPTS.get(block.language):
            text = block.text.replace("\\\n", " ")
            for words in commands("\n".join(re.findall(prompt, text, re.MULTILINE))):
                yield block, words


def called(words: list[str]) -> tuple[str, list[str]] | None:
    """Return program and arguments of a command that one of our programs runs."""
    while words and (words[0] in ("sudo", "export") or re.match(r"\w+=", words[0])):
        words = words[1:]
    if not words or Path(words[0]).name not in programs():
        return None
    return Path(words[0]).name, words[1:]


def unknown_flags(program: str, arguments: list[str]) -> list[str]:
    """Return what the parser of a program does not know: its command, or flags."""
    parser = programs()[program]
    arguments = arguments[: arguments.index("--")] if "--" in arguments else arguments
    known = set(parser._option_string_actions)
    for name in (word for word in arguments if not word.startswith("-")):
        if not (offered := subcommands(parser)):
            break
        if name not in offered:
            return [name]
        parser = offered[name]
        known |= set(parser._option_string_actions)
    flags = [word.partition("=")[0] for word in arguments if re.match(r"--?[a-z]", word)]
    return [flag for flag in flags if flag not in known]


def refused_block(program: str, arguments: list[str]) -> str:
    """Return what the parser says against a whole command line, empty if it accepts it."""
    if program == "vramctl" and arguments[:1] == ["calibrate"] and "--" in arguments:
        arguments = arguments[: arguments.index("--")]  # the command itself does so
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            programs()[program].parse_args(arguments)
        except SystemExit as end:
            return "" if end.code == 0 else said.getvalue().splitlines()[-1]
        except (VramError, argparse.ArgumentTypeError) as error:
            return str(error)
    return ""


def test_commands_are_what_the_programs_take() -> None:
    wrong, seen = [], list[str]()
    for block, words in typed():
        if (call := called(words)) is None:
            continue
        program, arguments = call
        seen.append(program)
        if problem := unknown_flags(program, arguments) or refused_block(program, arguments):
            wrong.append(f"{block.page.relative_to(ROOT)}: {' '.join(words)}: {problem}")
    assert wrong == []
    assert set(seen) == set(programs())
    assert len(seen) > 100


def test_commands_within_sentences_have_known_flags() -> None:
    wrong = []
    for page in PAGES:
        if page.name == HISTORY:
            continue
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        for span in INLINE.findall(text):
            for words in commands(span):
                if (call := called(words)) and (unknown := unknown_flags(*call)):
                    wrong.append(f"{page.relative_to(ROOT)}: {span}: {unknown}")
    assert wrong == []


def test_targets_and_files_of_commands_exist() -> None:
    missing = []
    for block, words in typed():
        words = words[1:] if words[:1] == ["sudo"] else words
        targets = words[1:2] if words[:1] == ["make"] else []
        missing += [f"{block}: {name}" for name in targets if name not in TARGETS]
        files = [word for word in words if re.match(r"(examples|configs|tests)/", word)]
        missing += [f"{block}: {name}" for name in files if not (ROOT / name).exists()]
    assert missing == []


def test_named_extras_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = {
        extra
        for page in PAGES
        if page.name != HISTORY
        for listed in EXTRA.findall(page.read_text(encoding="utf-8"))
        for extra in listed.split(",")
    }
    assert named - set(project["optional-dependencies"]) == set()
    assert "ros2" in named


def test_a_wrong_command_is_found() -> None:
    """The checks can fail."""
    assert unknown_flags("vramctl", ["why", "grab", "--nothing"]) == ["--nothing"]
    assert unknown_flags("vramctl", ["nothing"]) == ["nothing"]
    assert "--vram" in refused_block("vramctl", ["run", "--", "true"])
    assert [called(words) for words in commands("sudo X=1 vramctl status | head  # a")] == [
        ("vramctl", ["status"]), None,
    ]  # fmt: skip


# -- Python, YAML, JSON ----------------------------------------------------------------------------
@pytest.mark.parametrize("block", of("python"), ids=str)
def test_python_compiles_and_imports_what_exists(block: Block) -> None:
    for node in ast.walk(ast.parse(block.text)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vram_arbiter"):
            module = import_module(node.module or "")
            assert [name.name for name in node.names if not hasattr(module, name.name)] == []


def robot_of_block(**parts: object) -> None:
    whole = {"robot_id": "page", "hal": {"adapter": "so101_mujoco"}, **parts}
    load_robot(yaml.safe_dump(whole), "page")


def skill_of_block(**parts: object) -> None:
    shipped = (ROOT / "configs/rskills/so101-grab/rskill.yaml").read_text(encoding="utf-8")
    parse_manifest(yaml.safe_dump({**yaml.safe_load(shipped), **parts}))


KINDS: Mapping[frozenset[str], Callable[[str], object]] = {
    frozenset({"schema_version"}): parse_manifest,
    frozenset({"policy_extras"}): lambda text: skill_of_block(**yaml.safe_load(text)),
    frozenset({"robot_id"}): lambda text: load_robot(text, "page"),
    frozenset({"sensors"}): lambda text: robot_of_block(**yaml.safe_load(text)),
    frozenset({"sidecars"}): lambda text: robot_of_block(**yaml.safe_load(text)),
    frozenset({"model", "ends"}): lambda text: robot_of_block(
        hal={"adapter": "mujoco", "params": yaml.safe_load(text)}
    ),
    frozenset({"hooks"}): lambda text: load_observer(text, "page"),
    frozenset({"http"}): lambda text: load_observer(text, "page"),
    frozenset({"steps"}): lambda text: load_scenario(text, "page"),
    frozenset({"gpu"}): lambda text: load_config(text, "page"),
    frozenset({"revoke"}): lambda text: load_config(text, "page"),
    frozenset({"servers"}): lambda text: load_gateway(text, "page"),
    frozenset({"keys"}): lambda text: load_keys(text, "page"),
    frozenset({"services"}): yaml.safe_load,  # compose
    frozenset({"scrape_configs"}): yaml.safe_load,  # Prometheus
    frozenset({"workerGroupSpecs"}): yaml.safe_load,  # KubeRay
    frozenset({"spec"}): yaml.safe_load,  # Kubernetes
}
"""How a block is checked that has these keys: the first row of which it has all."""


@pytest.mark.parametrize("block", of("yaml"), ids=str)
def test_yaml_is_what_our_models_accept(block: Block) -> None:
    keys = set(yaml.safe_load(block.text))
    check = next((check for needed, check in KINDS.items() if needed <= keys), None)
    assert check is not None, f"no kind of file has these keys: {keys}"
    check(block.text)


@pytest.mark.parametrize("block", of("json"), ids=str)
def test_json_is_json(block: Block) -> None:
    json.loads(block.text)


# -- the site --------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT, capture_output=True, text=True, timeout=SITE_LIMIT_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.heavy
@pytest.mark.nightly
def test_the_site_is_built_without_a_warning_and_needs_no_other_host(site: Path) -> None:
    loaded = re.compile(
        r"<(?:script|img|iframe)[^>]+src=\"(?:https?:)?//[^\"]*|"
        r"<link[^>]+rel=\"(?:stylesheet|preconnect|preload)\"[^>]+href=\"(?:https?:)?//[^\"]*"
    )
    pages = {page: page.read_text(encoding="utf-8") for page in site.rglob("*.html")}
    assert [f"{page}: {hit}" for page, text in pages.items() for hit in loaded.findall(text)] == []
    assert [page for page, text in pages.items() if "<!-- generated:" in text] == []


@pytest.mark.heavy
@pytest.mark.nightly
def test_the_search_index_is_small(site: Path) -> None:
    """A browser loads and builds it at the first search: 700 kB took it half a second."""
    assert (site / "search/search_index.json").stat().st_size < 550_000


# Text and background of the theme, by scheme: hex colors, or properties of docs/site.css.
TEXTS = {
    "default": [
        ("--md-primary-fg-color", "#ffffff"),  # links, and the header the other way round
        ("--md-primary-fg-color", "#f5f5f5"),  # links in code
        ("--md-accent-fg-color", "#ffffff"),
        ("--md-default-fg-color--light", "#f5f5f5"),  # comments in code
    ],
    "slate": [
        ("#00ccb8", "#272a35"),  # links in code
        ("--md-accent-fg-color", "#1e2129"),
        ("--md-default-fg-color--light", "#272a35"),
        ("--md-code-hl-constant-color", "#272a35"),
        ("--md-code-hl-number-color", "#272a35"),
    ],
}


def luminance(color: str) -> float:
    """Return the relative luminance of `#rrggbb` as WCAG 2 defines it."""
    parts = [int(color[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    red, green, blue = (
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
    )
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@pytest.mark.parametrize("scheme", TEXTS)
def test_texts_of_the_site_have_the_contrast_of_wcag_aa(scheme: str) -> None:
    """White on the theme's teal had 3.8:1, the tabs 2.6:1."""
    style = (ROOT / "docs/site.css").read_text(encoding="utf-8")
    colors: dict[str, str] = {}
    for selector, body in re.findall(r"^(\[.*?) \{(.*?)\}", style, re.MULTILINE | re.DOTALL):
        if "scheme" not in selector or scheme in selector:
            colors |= dict(re.findall(r"(--[\w-]+): (#\w{6});", body))
    for text, background in TEXTS[scheme]:
        pair = sorted((luminance(colors.get(text, text)), luminance(background)))
        assert (pair[1] + 0.05) / (pair[0] + 0.05) >= 4.5, (text, background)


@pytest.mark.heavy
@pytest.mark.nightly
def test_the_reference_has_every_command_key_and_error(site: Path) -> None:
    for program, parser in programs().items():
        text = (site / f"reference/cli/{program}.html").read_text(encoding="utf-8")
        for name, command in {program: parser, **subcommands(parser)}.items():
            missing = [
                flag
                for flag in set(command._option_string_actions) - {"--help", "--version"}
                if flag.startswith("--") and flag not in text
            ]
            assert missing == [], name
    configuration = (site / "reference/configuration.html").read_text(encoding="utf-8")
    shipped = yaml.safe_load((ROOT / "configs/arbiter.yaml").read_text(encoding="utf-8"))
    keys = [key for section in shipped.values() for key in section]
    assert [key for key in keys if f"<code>{key}</code>" not in configuration] == []
    api = (site / "reference/api.html").read_text(encoding="utf-8")
    names = ("AsyncClient", "Client", "Lease", "LeaseSpec", "Footprint", "Handlers", "acquire")
    assert [name for name in names if f">{name}</span>" not in api and f"{name}<" not in api] == []
