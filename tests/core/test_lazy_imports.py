"""Packages that import on demand give every name that they promise, and nothing before it is asked for."""

import subprocess
import sys
from importlib import import_module

import pytest

PACKAGES = [f"autotuner.core.{name}" for name in ("diagnosis", "identification", "monitoring", "design")]


@pytest.mark.parametrize("name", PACKAGES)
def test_every_promised_name_is_there(name):
    package = import_module(name)
    homes = {one: getattr(package, one) for one in package.__all__}
    assert all(value is not None and not repr(value).startswith("<module") for value in homes.values())
    with pytest.raises(AttributeError, match="has no attribute"):
        getattr(package, "nobody")  # noqa: B009 - the very call


@pytest.mark.parametrize("name", PACKAGES)
def test_importing_a_package_imports_none_of_its_modules(name):
    found = f"import sys, {name}; print([one for one in sys.modules if one.startswith('{name}.')])"
    told = subprocess.run([sys.executable, "-c", found], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"
