"""The documentation says what the code does: keys, phases, commands and links are compared, not believed."""

import importlib
import re
import shlex
import sys

import pytest

from autotuner.cli import main
from autotuner.configuration import Configuration, LearnedTable, LoopTable, ServiceTable, Table, load_configuration
from autotuner.core.design import rule_names
from autotuner.core.experiment.phases import PHASES, Phase
from autotuner.errors import ConfigurationError, LinkError
from autotuner.ports import OUTPUT, PV, Backend

TABLES = {
    name: field.annotation
    for name, field in LoopTable.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, Table)
}
SECTIONS = {
    "## `[loops.NAME]`": LoopTable,
    **{f"### `[loops.NAME.{name}]`": table for name, table in TABLES.items()},
    "## `[service]`": ServiceTable,
    "## `[learned]`": LearnedTable,
}
"""Which section of docs/configuration.md describes which table."""


@pytest.fixture(scope="module")
def text(root):
    """Return a function that gives the text of a file of the repository."""
    return lambda name: (root / name).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def documents(repository_files):
    """Every page that a reader may open."""
    return [path for path in repository_files if path.suffix == ".md"]


def section(page, heading):
    """Return the part of a page from its heading to the next heading of the same or a higher level."""
    level = heading.partition(" ")[0]
    after = page.split(heading + "\n", 1)[1]
    return re.split(rf"^#{{1,{len(level)}}} ", after, maxsplit=1, flags=re.MULTILINE)[0]


def keys_in(part):
    """Return the keys in the first column of the tables of a part."""
    rows = re.findall(r"^\| (`[^|]+) \|", part, re.MULTILINE)
    return {key for row in rows for key in re.findall(r"`(\w+)`", row)}


@pytest.mark.parametrize("heading", SECTIONS)
def test_every_key_of_the_configuration_is_described(text, heading):
    described = keys_in(section(text("docs/configuration.md"), heading).partition("\n#")[0])
    elsewhere = {*TABLES, "device"} if SECTIONS[heading] is LoopTable else set()
    assert described == set(SECTIONS[heading].model_fields) - elsewhere


def test_every_table_of_the_configuration_has_its_section(text):
    assert set(Configuration.model_fields) == {"service", "learned", "loops"}
    assert "### `[loops.NAME.device]`" in text("docs/configuration.md")


def test_every_option_of_every_driver_is_described(text, pyproject):
    page = text("docs/configuration.md")
    for driver, place in pyproject["project"]["entry-points"]["autotuner.drivers"].items():
        module = importlib.import_module(place.partition(":")[0])
        options = set(re.findall(r"^    (\w+) = ", module.__doc__, re.MULTILINE))
        (heading,) = re.findall(rf'^#### `driver = "{driver}"`.*$', page, re.MULTILINE)
        assert options - set(re.findall(r"`(\w+)`", section(page, heading))) == set(), driver


def test_the_diagram_of_the_phases_is_drawn_from_the_table(text):
    """To renew it: python -c "from autotuner.core.experiment.phases import PHASES; print(PHASES.mermaid())"."""
    assert re.search(r"```mermaid\n(.*?)```", text("docs/phases.md"), re.DOTALL)[1] == PHASES.mermaid()


def test_every_phase_is_described(text):
    assert {phase.value for phase in Phase} == keys_in(text("docs/phases.md"))


def test_every_example_of_a_configuration_is_accepted(root):
    examples = sorted(root.glob("examples/*.toml"))
    assert examples
    for path in examples:
        assert load_configuration(path).loops


def test_every_configuration_in_a_page_is_accepted(documents, root, tmp_path, monkeypatch):
    monkeypatch.chdir(root)
    monkeypatch.setattr("sys.path", [*sys.path])  # a page may name a folder of modules
    blocks = [b for page in documents for b in re.findall(r"```toml\n(.*?)```", page.read_text("utf-8"), re.DOTALL)]
    assert blocks
    for block in blocks:
        (tmp_path / "block.toml").write_text(block, encoding="utf-8")
        assert main(["check", str(tmp_path / "block.toml")]) == 0


def test_prose_has_short_lines(documents):
    for page in documents:
        prose = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        lines = [line for line in prose.splitlines() if not line.startswith(("|", "!", "#"))]
        made = page.parent.name in {"reference", "artefacts"}
        assert made or max(map(len, lines)) <= 120, page


def test_code_has_a_language(documents):
    """The site colours it by that."""
    for page in documents:
        fences = re.findall(r"^```(.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
        assert all(fences[::2]), page
        assert not any(fences[1::2]), page


def test_links_lead_somewhere(root, documents):
    for page in documents:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page}: {target}"


def commands_of(documents, program):
    """Yield the words of every command line of a program that stands in a shell block of a page."""
    for page in documents:
        for block in re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                if line.split()[: len(program)] == program:
                    yield page, shlex.split(line, comments=True)[len(program) :]


def options_of(word, capsys):
    with pytest.raises(SystemExit):
        main([word, "--help"])
    return set(re.findall(r"--[a-z][a-z-]*", capsys.readouterr().out))


def options_of_benchmark(root, name):
    """From its text: running a benchmark for its help loads all that it needs."""
    (file,) = (root / "benchmarks").rglob(f"{name}.py")
    return set(re.findall(r'"(--[a-z][a-z-]*)"', file.read_text(encoding="utf-8")))


def test_commands_that_the_pages_tell_exist(documents, root, capsys):
    told = [*commands_of(documents, ["autotuner"]), *commands_of(documents, ["python3", "run.py"])]
    assert len(told) >= 6
    for page, words in told:
        if words[0] in {"test", "quick", "coverage", "--version", "--help"}:
            continue
        options = {word.partition("=")[0] for word in words[1:] if word.startswith("--")}
        benchmark = words[0] == "bench" and len(words) > 1
        unknown = options - (options_of_benchmark(root, words[1]) if benchmark else options_of(words[0], capsys))
        assert not unknown, f"{page}: autotuner {words[0]} has no {unknown}"


def test_the_readme_opens_with_the_two_commands(text):
    first = re.search(r"```sh\n(.*?)```", text("README.md"), re.DOTALL)
    lines = [line.partition("#")[0].strip() for line in first[1].splitlines()]
    assert lines == ["python3 run.py tune", "python3 run.py test"]
    assert len(text("README.md")[: first.start()].splitlines()) <= 12


def test_every_rule_is_named_in_the_method(text):
    page = text("docs/method.md")
    assert [name for name in rule_names() if f"`{name}`" not in page] == []


def test_the_readme_closes_its_first_walk_as_the_program_does(text, capsys):
    assert main(["tune"]) == 0
    closing = capsys.readouterr().out.strip().rpartition("\n\n")[2]
    assert f"```text\n{closing}\n```" in text("README.md")


async def test_the_driver_in_the_page_is_one(text):
    (code,) = re.findall(r"```python\n(.*?)```", text("docs/drivers.md"), re.DOTALL)
    page = {}
    exec(compile(code, "docs/drivers.md", "exec"), page)  # noqa: S102 - the page is ours
    with pytest.raises(ConfigurationError, match="room_c"):
        page["create"]({"room_c": "warm"})
    kettle = page["create"]({})
    assert isinstance(kettle, Backend)
    with pytest.raises(LinkError):
        await kettle.read([PV])
    await kettle.open()
    await kettle.write({OUTPUT: 50.0})
    assert await kettle.read([PV]) == {PV: 60.0}
    await kettle.close()


def test_every_question_of_the_architecture_map_is_answered_in_one_hop(text, root):
    rows = re.findall(
        r"^\| [^|]+\? \| [^|]*?`([\w/.]+)`[^|]* \| ((?:`[^`]+`(?:, )?)+) \|$",
        text("docs/architecture.md"),
        re.MULTILINE,
    )
    assert len(rows) >= 12
    for place, terms in rows:
        path = root / place
        files = [path] if path.is_file() else [*path.glob("*.py")]
        found = "".join(file.read_text(encoding="utf-8") for file in files).casefold()
        assert found, place
        for term in re.findall(r"`([^`]+)`", terms):
            assert term.rpartition(".")[2].casefold() in found, f"{place}: {term}"
