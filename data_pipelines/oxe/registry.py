"""All datasets by name, and named mixtures of them."""

import difflib

from data_pipelines.oxe import datasets_converted, datasets_other, datasets_reached, datasets_rtx
from data_pipelines.oxe.dataset import OxeDataset
from data_pipelines.oxe.datasets_converted import SUFFIX
from dsvla_jax.errors import UserError

MODULES = (datasets_rtx, datasets_converted, datasets_reached, datasets_other)
"""Where the datasets are described."""
DATASETS: dict[str, OxeDataset] = {dataset.name: dataset for module in MODULES for dataset in module.DATASETS}

_SOUP: dict[str, float] = {
    "fractal20220817_data": 0.54087122203,
    "kuka": 0.8341046294,
    "bridge_orig": 1.0,
    "taco_play": 2.0,
    "jaco_play": 1.0,
    "berkeley_cable_routing": 1.0,
    "roboturk": 2.0,
    "viola": 2.0,
    "berkeley_autolab_ur5": 2.0,
    "toto": 1.0,
    "language_table": 0.1,
    f"stanford_hydra_dataset{SUFFIX}": 2.0,
    f"austin_buds_dataset{SUFFIX}": 1.0,
    f"nyu_franka_play_dataset{SUFFIX}": 3.0,
    f"furniture_bench_dataset{SUFFIX}": 0.1,
    f"ucsd_kitchen_dataset{SUFFIX}": 2.0,
    f"austin_sailor_dataset{SUFFIX}": 1.0,
    f"austin_sirius_dataset{SUFFIX}": 1.0,
    f"dlr_edan_shared_control{SUFFIX}": 1.0,
    f"iamlab_cmu_pickup_insert{SUFFIX}": 1.0,
    "utaustin_mutex": 1.0,
    "berkeley_fanuc_manipulation": 2.0,
    "cmu_stretch": 1.0,
}
_PLUS = {**_SOUP, "bc_z": 0.2, "fmb_dataset": 1.0, "dobbe": 0.2, "droid": 0.06}

MIXTURES: dict[str, dict[str, float]] = {
    "rtx": {
        "fractal20220817_data": 0.54087122203,
        "kuka": 0.8341046294,
        "bridge_orig": 1.0,
        "taco_play": 2.0,
        "jaco_play": 2.0,
        "berkeley_cable_routing": 3.0,
        "roboturk": 1.0,
        "viola": 2.0,
        "berkeley_autolab_ur5": 1.0,
        "toto": 1.0,
    },
    "oxe_magic_soup": _SOUP,
    "oxe_magic_soup_plus": _PLUS,
    "oxe_magic_soup_plus_minus": {
        **{name: weight for name, weight in _PLUS.items() if name not in ("language_table", "droid")},
        "fractal20220817_data": 1.0,
    },
}
"""Weights as openvla's ``oxe/mixtures.py`` has them. A weight multiplies the dataset's number of samples."""


def get_dataset(name: str) -> OxeDataset:
    """The dataset of that name; raises UserError with the nearest one where there is none."""
    return _lookup(name, DATASETS, "dataset")


def get_mixture(names: tuple[str, ...]) -> dict[str, float]:
    """Weights by dataset.

    names: one named mixture, or datasets, each as ``NAME`` or ``NAME=WEIGHT`` (1 where not given).
    """
    if len(names) == 1 and names[0] in MIXTURES:
        return dict(MIXTURES[names[0]])
    weights: dict[str, float] = {}
    for entry in names:
        name, _, weight = entry.partition("=")
        _lookup(name, {**DATASETS, **MIXTURES}, "dataset or mixture")
        if name in MIXTURES:
            raise UserError(f"mixture: {name} is a mixture and stands alone; got {', '.join(names)}")
        if name in weights:
            raise UserError(
                f"mixture: {name} stands there twice; name it once, with a weight ({name}=2) for a larger share"
            )
        try:
            weights[name] = float(weight or 1.0)
        except ValueError:
            raise UserError(f"mixture: expected NAME=WEIGHT with a number, got {entry!r}") from None
        if not 0 < weights[name] < float("inf"):
            raise UserError(f"mixture: expected a positive weight, got {entry!r}; leave out what is not wanted")
    if not weights:
        raise UserError(f"mixture: expected datasets or one of {', '.join(MIXTURES)}, got none")
    return weights


def _lookup(name: str, table: dict, kind: str):
    if name not in table:
        near = difflib.get_close_matches(name, table, 1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise UserError(f"unknown {kind} {name!r}: {hint}`python -m data_pipelines.oxe list` names all")
    return table[name]
