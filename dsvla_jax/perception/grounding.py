"""Grounding DINO and SAM: phrases to boxes to masks. Needs the extra `perception` (torch, transformers).

The paper's chain (section 3.3) in the Hugging Face models. Thresholds are those of 3DS-VLA's authors.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dsvla_jax.errors import UserError
from dsvla_jax.perception.keypoints import ONE_END, OTHER_END, Sighting
from dsvla_jax.perception.phrases import ObjectPhrases, load_table
from dsvla_jax.ranges import at_least, check_fields

if TYPE_CHECKING:
    import transformers  # type: ignore[import-not-found]

DETECTOR = "IDEA-Research/grounding-dino-tiny"
SEGMENTER = "facebook/sam-vit-huge"
INSTALL = "install what it needs with: pip install torch torchvision transformers pillow"


@dataclasses.dataclass(frozen=True)
class GroundingOptions:
    """Command-line options of those who look for objects."""

    detector: str = DETECTOR
    """Grounding DINO: a name on the Hugging Face hub, or a folder."""
    mask_model: str = SEGMENTER
    """SAM: a name on the Hugging Face hub, or a folder."""
    box_threshold: float = 0.3
    """A phrase whose best box scores less is not found."""
    device: str = "cpu"
    """Torch's name of the device that looks."""
    phrases: Path | None = None
    """A JSON file of {"regular expression": ["phrase", ...]} for instructions that are not the suite's."""

    def __post_init__(self) -> None:
        check_fields(self, "", box_threshold=at_least(0, 1))

    def segmenter(self) -> "GroundedSegmenter":
        """Loads the models. Raises UserError."""
        return GroundedSegmenter.from_pretrained(self.detector, self.mask_model, self.box_threshold, self.device)

    def table(self) -> Sequence[ObjectPhrases]:
        """The rows of the file `phrases`, none without one. Raises UserError."""
        return () if self.phrases is None else load_table(self.phrases)


class GroundedSegmenter:
    """A `Segmenter`: for each phrase the best box of Grounding DINO, and SAM's mask in that box.

    box_threshold: a phrase whose best box scores less is not found. device: torch's name of it.
    """

    def __init__(
        self,
        detector: "transformers.GroundingDinoForObjectDetection",
        detector_processor: "transformers.GroundingDinoProcessor",
        segmenter: "transformers.SamModel",
        segmenter_processor: "transformers.SamProcessor",
        box_threshold: float = 0.3,
        device: str = "cpu",
    ) -> None:
        self._detector, self._segmenter = detector.to(device).eval(), segmenter.to(device).eval()
        self._read_detector, self._read_segmenter = detector_processor, segmenter_processor
        self._threshold, self._device = box_threshold, device

    @classmethod
    def from_pretrained(
        cls, detector: str = DETECTOR, segmenter: str = SEGMENTER, box_threshold: float = 0.3, device: str = "cpu"
    ) -> "GroundedSegmenter":
        """The models of two names on the Hugging Face hub, or folders. Raises UserError where they cannot be had."""
        try:
            import transformers  # type: ignore[import-not-found]

            return cls(
                transformers.GroundingDinoForObjectDetection.from_pretrained(detector),
                transformers.GroundingDinoProcessor.from_pretrained(detector),
                transformers.SamModel.from_pretrained(segmenter),
                transformers.SamProcessor.from_pretrained(segmenter),
                box_threshold,
                device,
            )
        except ImportError as error:
            # Without torch or torchvision, transformers is there and its models are not.
            reason = f"{error.name} is missing" if error.name else str(error).strip().splitlines()[0]
            raise UserError(f"perception: {reason}; {INSTALL}") from error
        except (OSError, ValueError) as error:
            raise UserError(
                f"perception: cannot load {detector} and {segmenter} ({error}); give folders that hold them where the "
                "hub is out of reach"
            ) from error

    def __call__(self, rgb: np.ndarray, phrases: Sequence[str]) -> list[Sighting]:
        """What of each phrase is in the picture uint8 (H, W, 3)."""
        return [self._find(rgb, phrase) for phrase in phrases]

    def _find(self, rgb: np.ndarray, phrase: str) -> Sighting:
        box, score = self._detect(rgb, phrase.removesuffix(ONE_END).removesuffix(OTHER_END))
        if score < self._threshold:
            problem = f"the best box scores {score:.2f}, less than {self._threshold:g}"
            return Sighting(phrase, score=score, problem=problem)
        mask = self._segment(rgb, box)
        return Sighting(phrase, mask, score, box, "" if mask.any() else "its mask is empty")

    def _detect(self, rgb: np.ndarray, phrase: str) -> tuple[tuple[float, float, float, float], float]:
        """The box (x0, y0, x1, y1) in pixels that fits the phrase best, and its score."""
        import torch  # type: ignore[import-not-found]

        # Grounding DINO was trained with lower-case phrases that end in a full stop.
        inputs = self._read_detector(images=rgb, text=f"{phrase.lower()}.", return_tensors="pt").to(self._device)
        with torch.inference_mode():
            outputs = self._detector(**inputs)
        height, width = rgb.shape[:2]
        (found,) = self._read_detector.post_process_grounded_object_detection(
            outputs, inputs["input_ids"], threshold=0.0, text_threshold=0.0, target_sizes=[(height, width)]
        )
        best = int(found["scores"].argmax())
        x0, y0, x1, y1 = found["boxes"][best].tolist()
        box = (max(x0, 0.0), max(y0, 0.0), min(x1, width - 1.0), min(y1, height - 1.0))
        return box, float(found["scores"][best])

    def _segment(self, rgb: np.ndarray, box: tuple[float, float, float, float]) -> np.ndarray:
        """SAM's mask bool (H, W) for a box."""
        import torch  # type: ignore[import-not-found]

        inputs = self._read_segmenter(rgb, input_boxes=[[list(box)]], return_tensors="pt").to(self._device)
        with torch.inference_mode():
            outputs = self._segmenter(**inputs, multimask_output=False)
        masks = self._read_segmenter.image_processor.post_process_masks(
            outputs.pred_masks.cpu(), inputs["original_sizes"].cpu(), inputs["reshaped_input_sizes"].cpu()
        )
        return masks[0].numpy().reshape(rgb.shape[:2])
