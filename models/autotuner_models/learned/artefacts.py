"""Trained corrections on disk: plain arrays for use, scikit-learn's objects for study, a manifest for both.

Invariants:

1. The SHA-256 of a file is compared with the manifest before anything in it is read.
2. The joblib file, which is unpickled, is loaded only for a family other than the network, or on request; the networks
   are read from the arrays.
3. Every error is a `ConfigurationError` that names the command to train again.

The file of arrays is one line of JSON, shapes by name, and after it the numbers in that order, row by row, as
little-endian doubles: it needs no library to be read (see `plain`).
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import platform
from dataclasses import fields
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from autotuner.core.identification.learned.correction import Correction, Domain, LearnedModels, Networks
from autotuner.errors import ConfigurationError
from autotuner_models.learned.training import NETWORK, Regressors

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Arrays = dict[str, NDArray[np.float64]]

SHIPPED = Path(__file__).parent.parent / "artefacts"
MANIFEST, ARRAYS, OBJECTS = "manifest.json", "learned.arrays", "learned.joblib"
FORMAT = 1
"""Version of features and arrays: a change of either needs new training."""
LIBRARIES = ("scikit-learn", "numpy", "joblib")
PLAIN = ("q68", "q95", "least", "most")
"""Fields of a correction that are arrays of their own."""
RETRAIN = "Train again with `autotuner train --out DIR` and set `[learned] artefacts` to DIR."


def save(folder: Path, models: LearnedModels, objects: object, about: Mapping[str, object]) -> None:
    """Write arrays, objects and manifest; the manifest last, so that an interrupted write is not taken for a whole one.

    Raises
    ------
    ConfigurationError
        The folder cannot be written.
    """
    import joblib  # noqa: PLC0415 - only writing needs it

    pickled = io.BytesIO()
    joblib.dump(objects, pickled, compress=6)
    files = {ARRAYS: _packed(_flat(models)), OBJECTS: pickled.getvalue()}
    manifest = {
        "format": FORMAT,
        "sha256": {name: hashlib.sha256(data).hexdigest() for name, data in files.items()},
        "versions": {name: version(name) for name in LIBRARIES} | {"python": platform.python_version()},
        "machine": _machine(),
        **about,
    }
    files[MANIFEST] = (json.dumps(manifest, indent=1) + "\n").encode()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            (folder / name).write_bytes(data)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}",
            field="--out",
            value=str(folder),
            remedy="Give a folder that may be written to.",
        ) from error


def _machine() -> dict[str, object]:
    """Return the causes of different last bits: the processor and the libraries of linear algebra."""
    pools = import_module("threadpoolctl").threadpool_info()  # comes with scikit-learn
    keys = ("internal_api", "version", "architecture", "threading_layer")
    libraries = [{key: pool[key] for key in keys if key in pool} for pool in pools]
    return {"processor": platform.machine(), "system": platform.system(), "libraries": libraries}


def load(folder: Path = SHIPPED) -> LearnedModels:
    """Return the trained corrections of a folder: networks from plain arrays, other families from their objects.

    Raises
    ------
    ConfigurationError
        A file is missing, differs from its hash in the manifest, or has another format.
    """
    manifest = read_manifest(folder)
    data = _vouched(folder, ARRAYS, manifest)
    if manifest.get("format") != FORMAT:
        raise _wrong(folder / ARRAYS, f"is of format {manifest.get('format')}, not {FORMAT}")
    objects = {} if manifest.get("family", NETWORK) == NETWORK else load_objects(folder)
    return _from_flat(_unpacked(data), manifest, objects)


def load_objects(folder: Path = SHIPPED) -> dict[str, Any]:
    """Return scikit-learn's trained objects: pipelines by structure.

    Raises
    ------
    ConfigurationError
        As for `load`, or a library is of another version than the one trained with.
    """
    import joblib  # noqa: PLC0415 - the arrays do without

    manifest = read_manifest(folder)
    data = _vouched(folder, OBJECTS, manifest)
    versions = manifest.get("versions")
    for name in LIBRARIES:
        trained = versions.get(name) if isinstance(versions, dict) else None
        if not isinstance(trained, str) or trained.split(".")[:2] != version(name).split(".")[:2]:
            raise _wrong(folder / OBJECTS, f"was trained with {name} {trained}, and {version(name)} is installed")
    objects: dict[str, Any] = joblib.load(io.BytesIO(data))
    return objects


def read_manifest(folder: Path) -> dict[str, object]:
    """Return the manifest of a folder."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except OSError as error:
        raise _wrong(folder / MANIFEST, f"cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise _wrong(folder / MANIFEST, "is not JSON") from error
    if not isinstance(manifest, dict):
        raise _wrong(folder / MANIFEST, "is not a manifest")
    return manifest


def _vouched(folder: Path, name: str, manifest: Mapping[str, object]) -> bytes:
    try:
        data = (folder / name).read_bytes()
    except OSError as error:
        raise _wrong(folder / name, f"cannot be read: {error.strerror}") from error
    hashes = manifest.get("sha256")
    if not isinstance(hashes, dict) or hashes.get(name) != hashlib.sha256(data).hexdigest():
        raise _wrong(folder / name, "is not the file that its manifest vouches for")
    return data


def _wrong(path: Path, message: str) -> ConfigurationError:
    return ConfigurationError(f"{path} {message}", field="learned", remedy=RETRAIN)


def _packed(arrays: Arrays) -> bytes:
    header = json.dumps({name: array.shape for name, array in arrays.items()}).encode()
    return header + b"\n" + b"".join(array.astype("<f8").tobytes() for array in arrays.values())


def _unpacked(data: bytes) -> Arrays:
    header, _, numbers = data.partition(b"\n")
    arrays, offset = {}, 0
    for name, shape in json.loads(header).items():
        count = math.prod(shape)
        arrays[name] = np.frombuffer(numbers, "<f8", count, offset).astype(np.float64).reshape(shape)
        offset += 8 * count
    return arrays


def _flat(models: LearnedModels) -> Arrays:
    arrays: Arrays = {}
    for name, one in models.corrections.items():
        arrays |= {f"{name}/{key}": getattr(one, key) for key in PLAIN}
        networks = _flat_networks(f"{name}/networks", one.networks) if isinstance(one.networks, Networks) else {}
        arrays |= networks | _flat_domain(f"{name}/domain", one.domain)
    return (
        arrays
        | _flat_networks("classes/networks", models.classifier)
        | _flat_domain("classes/domain", models.classifier_domain)
    )


def _flat_networks(key: str, networks: Networks) -> Arrays:
    return {f"{key}/w{i}": w for i, w in enumerate(networks.weights)} | {
        f"{key}/b{i}": b for i, b in enumerate(networks.offsets)
    }


def _flat_domain(key: str, domain: Domain) -> Arrays:
    return {f"{key}/{f.name}": np.asarray(getattr(domain, f.name)) for f in fields(domain)}


def _from_flat(arrays: Arrays, manifest: Mapping[str, object], objects: Mapping[str, Any]) -> LearnedModels:
    names = sorted({key.split("/")[0] for key in arrays} - {"classes"})
    corrections = {
        name: Correction(
            networks=Regressors(objects[name]) if name in objects else _networks(f"{name}/networks", arrays),
            domain=_domain(f"{name}/domain", arrays),
            **{key: arrays[f"{name}/{key}"] for key in PLAIN},
        )
        for name in names
    }
    about = {
        key: manifest.get(key) for key in ("sha256", "versions", "seed", "data_sha256", "family", "ranges", "noise")
    }
    return LearnedModels(corrections, _networks("classes/networks", arrays), _domain("classes/domain", arrays), about)


def _networks(key: str, arrays: Arrays) -> Networks:
    layers = range(sum(name.startswith(f"{key}/w") for name in arrays))
    return Networks(
        tuple(np.ascontiguousarray(arrays[f"{key}/w{i}"]) for i in layers),
        tuple(arrays[f"{key}/b{i}"] for i in layers),
    )


def _domain(key: str, arrays: Arrays) -> Domain:
    parts = {f.name: arrays[f"{key}/{f.name}"] for f in fields(Domain)}
    return Domain(parts["low"], parts["high"], parts["mean"], parts["whitening"], float(parts["farthest"]))
