"""All datasets by name, and named mixtures of them."""

import difflib
from collections.abc import Mapping
from types import ModuleType
from typing import TypeVar

from data_pipelines.oxe.dataset import OxeDataset
from data_pipelines.oxe.datasets import (
    aloha,
    asu,
    austin,
    berkeley,
    bridge,
    cmu,
    columbia,
    dlr,
    droid,
    furniture_bench,
    google,
    imperial_college,
    jaco_play,
    kaist,
    keyframes,
    libero,
    maniskill,
    mujoco_manip,
    navigation,
    nyu,
    rh20t,
    robo_net,
    stanford,
    taco_play,
    tokyo,
    toto,
    ucsd,
    uiuc,
)
from data_pipelines.oxe.layouts import SUFFIX
from dsvla_jax.errors import UserError

DESCRIBED_IN: dict[str, ModuleType] = {
    "aloha_dagger_dataset": aloha,
    "aloha_mobile_dataset": aloha,
    "aloha_static_dataset": aloha,
    "asu_table_top_converted_externally_to_rlds": asu,
    "austin_buds_dataset_converted_externally_to_rlds": austin,
    "austin_sailor_dataset_converted_externally_to_rlds": austin,
    "austin_sirius_dataset_converted_externally_to_rlds": austin,
    "bc_z": google,
    "berkeley_autolab_ur5": berkeley,
    "berkeley_cable_routing": berkeley,
    "berkeley_fanuc_manipulation": berkeley,
    "berkeley_gnm_cory_hall": navigation,
    "berkeley_gnm_recon": navigation,
    "berkeley_gnm_sac_son": navigation,
    "berkeley_mvp_converted_externally_to_rlds": berkeley,
    "berkeley_rpt_converted_externally_to_rlds": berkeley,
    "bridge_dataset": bridge,
    "bridge_orig": bridge,
    "bridge_oxe": bridge,
    "cmu_franka_exploration_dataset_converted_externally_to_rlds": cmu,
    "cmu_play_fusion": cmu,
    "cmu_playing_with_food": cmu,
    "cmu_stretch": cmu,
    "columbia_cairlab_pusht_real": columbia,
    "dlr_edan_shared_control_converted_externally_to_rlds": dlr,
    "dlr_sara_grid_clamp_converted_externally_to_rlds": dlr,
    "dlr_sara_pour_converted_externally_to_rlds": dlr,
    "dobbe": nyu,
    "droid": droid,
    "droid_wipe": droid,
    "fmb_dataset": berkeley,
    "fractal20220817_data": google,
    "furniture_bench_dataset_converted_externally_to_rlds": furniture_bench,
    "gnm_dataset": navigation,
    "iamlab_cmu_pickup_insert_converted_externally_to_rlds": cmu,
    "imperialcollege_sawyer_wrist_cam": imperial_college,
    "jaco_play": jaco_play,
    "kaist_nonprehensile_converted_externally_to_rlds": kaist,
    "keyframes_one_arm": keyframes,
    "keyframes_two_arms": keyframes,
    "kuka": google,
    "language_table": google,
    "libero_10_no_noops": libero,
    "libero_goal_no_noops": libero,
    "libero_object_no_noops": libero,
    "libero_spatial_no_noops": libero,
    "maniskill_dataset_converted_externally_to_rlds": maniskill,
    "mujoco_manip": mujoco_manip,
    "nyu_door_opening_surprising_effectiveness": nyu,
    "nyu_franka_play_dataset_converted_externally_to_rlds": nyu,
    "nyu_rot_dataset_converted_externally_to_rlds": nyu,
    "rh20t": rh20t,
    "robo_net": robo_net,
    "roboset": cmu,
    "roboturk": stanford,
    "stanford_hydra_dataset_converted_externally_to_rlds": stanford,
    "stanford_kuka_multimodal_dataset_converted_externally_to_rlds": stanford,
    "stanford_mask_vit_converted_externally_to_rlds": stanford,
    "stanford_robocook_converted_externally_to_rlds": stanford,
    "taco_play": taco_play,
    "tdroid_carrot_in_bowl": droid,
    "tdroid_cover_object_with_towel": droid,
    "tdroid_flip_pot_upright": droid,
    "tdroid_knock_object_over": droid,
    "tdroid_move_object_onto_plate": droid,
    "tdroid_pour_corn_in_pot": droid,
    "tokyo_u_lsmo_converted_externally_to_rlds": tokyo,
    "toto": toto,
    "ucsd_kitchen_dataset_converted_externally_to_rlds": ucsd,
    "ucsd_pick_and_place_dataset_converted_externally_to_rlds": ucsd,
    "uiuc_d3field": uiuc,
    "utaustin_mutex": austin,
    "utokyo_pr2_opening_fridge_converted_externally_to_rlds": tokyo,
    "utokyo_pr2_tabletop_manipulation_converted_externally_to_rlds": tokyo,
    "utokyo_xarm_bimanual_converted_externally_to_rlds": tokyo,
    "utokyo_xarm_pick_and_place_converted_externally_to_rlds": tokyo,
    "viola": austin,
}
"""Every dataset, and the module that describes it."""
DATASETS: dict[str, OxeDataset] = {
    dataset.name: dataset
    for name, module in DESCRIBED_IN.items()
    for dataset in module.DATASETS
    if dataset.name == name
}

T = TypeVar("T")

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


def _lookup(name: str, table: Mapping[str, T], kind: str) -> T:
    if name not in table:
        near = difflib.get_close_matches(name, table, 1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise UserError(f"unknown {kind} {name!r}: {hint}`python -m data_pipelines.oxe list` names all")
    return table[name]
