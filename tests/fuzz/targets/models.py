"""Model directories with a manifest that is true, as one file each; and the trees alone."""

from __future__ import annotations

import hashlib
import io
import json
import random
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from calibration.errors import CalibrationError
from calibration.numerics.stored_arrays import read_npz
from calibration.residual.trees.tree_text import read_trees
from daemon.models.first_load import encode, smoke_test
from daemon.warm_up import prepare
from tests.fuzz.mutate import change
from tests.fuzz.target import Run, Target, check_refusal

_KINDS = {"json": "json", "toml": "text", "txt": "text", "npz": "bytes"}
_TREE_WORDS = (
    b"num_leaves=",
    b"split_feature=",
    b"leaf_value=",
    b"1e300",
    b"nan",
    b"Tree=0\n",
    b"end of trees\n",
    b"-1 0 ",
)
_VALUES = (0.0, -1.0, 1e9, 1e18, 1e300, 1e-300, float("nan"), float("inf"))


def unbundle(data: bytes) -> dict[str, bytes]:
    """The files of a bundle, which `daemon.models.first_load.encode` made; none where it is damaged."""
    first, _, rest = data.partition(b"\n")
    try:
        sizes = json.loads(first)
        files, at = {}, 0
        for name, size in sizes.items():
            files[name] = rest[at : at + size]
            at += size
    except (ValueError, TypeError, AttributeError, RecursionError):
        return {}
    return files


def sealed(files: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files with a manifest that is true, and a model.json that names the rig file as it is."""
    files = dict(files)
    try:
        document = json.loads(files["model.json"])
        document["provenance"]["rig_sha256"] = hashlib.sha256(files["rig.toml"]).hexdigest()
        files["model.json"] = json.dumps(document).encode()
    except (ValueError, KeyError, TypeError, RecursionError):
        pass
    try:
        version = json.loads(files.pop("manifest.json"))["version"]
    except (ValueError, KeyError, TypeError, RecursionError):
        version = 3
    listed = {name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)} for name, data in files.items()}
    manifest = {"format": "rigcal model", "version": version, "files": listed}
    return files | {"manifest.json": json.dumps(manifest).encode()}


def _changed(rng: random.Random, data: bytes, corpus: list[bytes]) -> bytes:
    files = unbundle(data)
    if not files:
        return data
    for _ in range(rng.choice((1, 1, 1, 2))):
        name = rng.choice(sorted(files))
        others = [found[name] for each in corpus if name in (found := unbundle(each))]
        kind = _KINDS.get(name.rpartition(".")[2], "bytes")
        if kind == "bytes" and rng.random() < 0.7:
            files[name] = _changed_arrays(rng, files[name])
        else:
            files[name] = change(rng, kind, files[name], others)
    if rng.random() < 0.1:
        files.pop(rng.choice(sorted(files)))
    return encode(sealed(files) if rng.random() < 0.95 else files)


def _changed_arrays(rng: random.Random, data: bytes) -> bytes:
    try:
        arrays = read_npz(data)
    except ValueError:
        return data
    name = rng.choice(sorted(arrays))
    array = arrays[name]
    with suppress(ValueError):
        array = _changed_array(rng, array)
    out = io.BytesIO()
    save = np.savez if rng.random() < 0.95 else np.savez_compressed
    save(out, allow_pickle=False, **{**arrays, name: array})
    return out.getvalue()


def _changed_array(rng: random.Random, array: Any) -> Any:
    if array.dtype.kind == "f" and rng.random() < 0.5:
        flat = array.copy().reshape(-1)
        if flat.size and rng.random() < 0.7:
            flat[rng.randrange(flat.size)] = rng.choice(_VALUES)
        else:
            flat *= rng.choice((-1.0, 0.0, 1e9, 1e200))
        return flat.reshape(array.shape)
    match rng.randrange(4):
        case 0:
            return array[: rng.randrange(3)]
        case 1:
            return np.concatenate([array] * rng.choice((2, 5)))
        case 2:
            return array.astype(rng.choice(("<f4", "<i8", "<U3", "?", "<c16", ">f8")))
        case _:
            return array.T.reshape(-1)


def _model() -> Run:
    prepare()

    def run(data: bytes) -> None:
        try:
            smoke_test(unbundle(data))
        except CalibrationError as error:
            check_refusal(error)

    return run


def _trees() -> Run:
    def run(data: bytes) -> None:
        try:
            read_trees(data, 16)
        except ValueError as error:
            check_refusal(error)

    return run


TARGETS = [
    Target("model", _model, change=_changed, is_slow=True),
    Target("trees", _trees, "text", _TREE_WORDS, is_slow=True),
]
