"""HTML pages that need no other file and no network."""

import base64
from pathlib import Path

import cv2
import jinja2
import numpy as np

from dsvla_jax.files import replacing


def write_html(file: Path, template: Path, **values: object) -> None:
    """Fills in a template; the page appears whole, and needs no other file and no network.

    Its filters: `percent` of a share, and `picture` of uint8 (H, W, 3), which goes into an `img`.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template.parent), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"percent": lambda value: f"{100 * value:.1f}", "picture": png_data}
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as partial:
        partial.write_text(environment.get_template(template.name).render(**values), encoding="utf-8")


def png_data(rgb: np.ndarray) -> str:
    """uint8 (H, W, 3), RGB, as a data URI for a page."""
    encoded, data = cv2.imencode(".png", rgb[..., ::-1])
    if not encoded:
        raise ValueError(f"cannot encode an image of shape {rgb.shape} and type {rgb.dtype} as PNG")
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode()
