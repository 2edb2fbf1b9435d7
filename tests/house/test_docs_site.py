"""The documentation: its reference is that of the code, every page is in the menu, its Python runs, the site builds."""

import importlib.util
import re
import runpy
import sys

import pytest

from autotuner_models.thesis.pictures import drawings

PLACE = re.compile(r": ([\w./-]+\.md)$", re.MULTILINE)


@pytest.fixture(scope="module")
def reference(root):
    """Return the module that makes the reference."""
    spec = importlib.util.spec_from_file_location("make_reference", root / "docs" / "make_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["commands.md", "effects.md", "errors.md", "rest.md", "rules.md"])
def test_the_reference_is_that_of_the_code(root, reference, name):
    committed = (root / "docs" / "reference" / name).read_text(encoding="utf-8")
    assert committed == reference.PAGES[name](), "run: python docs/make_reference.py"


def test_the_reference_has_no_other_page(root, reference):
    assert {path.name for path in (root / "docs" / "reference").iterdir()} == set(reference.PAGES)


def test_every_page_is_in_the_menu_and_on_the_first_page(root):
    menu = PLACE.findall((root / "docs.yml").read_text(encoding="utf-8"))
    pages = {str(path.relative_to(root / "docs")) for path in (root / "docs").rglob("*.md")}
    listed = {page for page in pages if not page.startswith("decisions/0")}
    assert set(menu) == listed
    assert len(menu) == len(set(menu))
    first = (root / "docs" / "README.md").read_text(encoding="utf-8")
    assert {page for page in listed - {"README.md"} if f"]({page})" not in first} == set()


def test_every_picture_is_shown_and_has_words(root):
    pages = [*(root / "docs").rglob("*.md"), root / "README.md"]
    shown = [shot for page in pages for shot in re.findall(r"!\[(.*?)\]\((\S+)\)", page.read_text(encoding="utf-8"))]
    assert all(words for words, _ in shown)
    images = root / "docs" / "images"
    kept = {path.name for path in images.rglob("*") if path.is_file() and path.parent.name != "diagrams"}
    assert {place.rpartition("/")[2] for _, place in shown} >= kept
    makers = runpy.run_path(str(root / "docs" / "make_pictures.py"))
    assert makers["MADE"] | {drawing.file_name for drawing in drawings()} == kept


def test_every_diagram_has_its_picture_for_the_site(root):
    """To renew them: python docs/make_diagrams.py MERMAID.js."""
    hooks = runpy.run_path(str(root / "docs" / "site_hooks.py"))
    drawn = {}
    for page in (root / "docs").rglob("*.md"):
        for found in hooks["DIAGRAM"].finditer(page.read_text(encoding="utf-8")):
            drawn[root / "docs" / hooks["picture_of"](page.stem)] = hooks["source_hash"](found["source"])
    assert len(drawn) >= 3
    assert {path: path.read_text(encoding="utf-8").split()[1] for path in drawn} == drawn
    assert set((root / "docs" / "images" / "diagrams").iterdir()) == set(drawn)


def test_python_on_recordings_does_what_the_page_says(root, capsys):
    page = (root / "docs" / "how-to" / "call-it.md").read_text(encoding="utf-8")
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "autotuner_sim" in block]
    namespace = {}
    exec(compile(code, "call-it.md", "exec"), namespace)  # noqa: S102 - the page is ours
    model = namespace["identification"].model
    assert pytest.approx((2.0, 10.0, 1.5), rel=0.01) == (model.K, model.T, model.D)
    assert capsys.readouterr().out.endswith("adequate\n")


def test_a_file_of_the_repository_that_a_page_links_to_is_part_of_the_site(root):
    hooks = runpy.run_path(str(root / "docs" / "site_hooks.py"))
    page = "see [the example](../../examples/plc.toml), [another page](../safety.md), [the card](../../README.md)"
    files = hooks["linked_files"]({"how-to/plc-over-modbus.md": page})
    assert {"examples/plc.toml", "README.md"} <= files
    assert "docs/safety.md" not in files


def test_the_pins_of_the_site_are_exact_and_hashed(root, pyproject):
    text = (root / "constraints" / "docs.txt").read_text(encoding="utf-8")
    line = re.compile(r"    --hash=sha256:[0-9a-f]{64}( \\)?|[a-z0-9-]+==[\w.]+( ; [\w .'=!<>]+)? \\")
    assert [row for row in text.splitlines() if not line.fullmatch(row)] == []
    names = {re.split(r"[>=]", row)[0] for row in pyproject["project"]["optional-dependencies"]["docs"]}
    assert names <= set(re.findall(r"^([a-z0-9-]+)==", text, re.MULTILINE))


def test_the_site_builds(root, tmp_path):
    if importlib.util.find_spec("properdocs") is None:
        pytest.skip("ProperDocs is not installed (extra docs)")
    import subprocess

    command = [sys.executable, "-m", "properdocs", "build", "--strict", "--config-file", root / "docs.yml"]
    subprocess.run([*command, "--site-dir", tmp_path], check=True, capture_output=True)
    for path in tmp_path.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        assert re.findall(r'(?:src|<link[^>]* href)="(?:https?:)?//', text) == []
        assert "stateDiagram" not in text
        links = [link for link in re.findall(r'(?:src|href)="([^"#?]+)', text) if ":" not in link]
        places = {link: (tmp_path if link[0] == "/" else path.parent) / link.lstrip("/") for link in links}
        assert [link for link, place in places.items() if not place.exists()] == []
    assert 'src="images/diagrams/safety.svg"' in (tmp_path / "safety.html").read_text(encoding="utf-8")
    assert '<span class="k">class</span>' in (tmp_path / "drivers.html").read_text(encoding="utf-8")
