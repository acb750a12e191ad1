"""The simulator's own segmentation as masks of the objects that tasks name: what a perfect detector would find."""

import re

import numpy as np

from dsvla_jax.sim.episode import Environment
from dsvla_jax.sim.physics import SimState

# For each task the geoms of its objects, in the order of the instruction, as regular expressions of whole names.
# {colour} is the variation's. Of several blocks of one colour, one.
OBJECT_GEOMS: dict[str, tuple[str, ...]] = {
    "beat_the_buzz": ("wand_handle",),
    "bimanual_lift_ball": ("ball",),
    "bimanual_lift_tray": ("tray.*",),
    "bimanual_pick_laptop": ("laptop(?!_holder).*",),
    "bimanual_push_box": ("box.*", "target"),
    "bimanual_straighten_rope": (r"rope_(tail|head|\d+)", "rope_.*_target"),
    "change_clock": ("clock_knob",),
    "close_box": ("box_.*",),
    "close_fridge": ("fridge_.*",),
    "close_laptop_lid": ("laptop_(?!stand).*",),
    "lamp_on": ("lamp_button",),
    "open_microwave": ("microwave_handle.*",),
    "phone_on_base": ("phone_(handle|ear.)", "phone_base.*"),
    "place_wine_at_rack_location": ("wine_bottle.*", "wine_rack.*"),
    "press_switch": ("switch_lever",),
    "put_knife_on_chopping_board": ("knife_(handle|blade)", "knife_board.*"),
    "put_rubbish_in_bin": (r"rubbish(_crease\d)?", "rubbish_bin.*"),
    "stack_blocks": ("stack_target0", "stack_square"),
    "sweep_to_dustpan": ("broom_(head|bar|handle)", "dustpan_.*"),
    "take_frame_off_hanger": ("frame_(?!string).*",),
    "take_off_weighing_scales": ("pepper_{colour}_.*",),
    "take_umbrella_out_of_umbrella_stand": ("umbrella_(handle|hook.*)",),
    "take_usb_out_of_computer": ("usb(_connector)?",),
    "toilet_seat_down": (r"toilet_seat\d",),
    "unplug_charger": ("charger(_prong.|_light)?",),
    "water_plants": ("waterer_.*", "plant_.*"),
}


def object_geoms(environment: Environment, variation: int) -> list[list[int]]:
    """The geom ids of each of the task's objects, in `OBJECT_GEOMS`' order."""
    model, task = environment.scene.mj_model, environment.task
    names, words = [model.geom(i).name for i in range(model.ngeom)], task.words(variation)
    # Not str.format: a regular expression may have braces of its own.
    patterns = [pattern.replace("{colour}", words.get("colour", "")) for pattern in OBJECT_GEOMS[task.name]]
    return [[i for i, name in enumerate(names) if re.fullmatch(pattern, name)] for pattern in patterns]


def object_masks(environment: Environment, state: SimState) -> np.ndarray:
    """bool (B, K, H, W): the visible pixels of the K objects of the environment's task, in `OBJECT_GEOMS`' order."""
    segmentation = np.asarray(environment.render(state)[2])
    return np.array(
        [
            [np.isin(shown, geoms) for geoms in object_geoms(environment, variation)]
            for shown, variation in zip(segmentation, np.asarray(state.variation).tolist(), strict=True)
        ]
    )
