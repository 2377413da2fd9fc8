"""The views and the looks that a probe gives to a scene, by name. What a policy remembers is not touched."""

from collections.abc import Mapping

from vla_eval.config.appearance import AppearanceSettings
from vla_eval.cue_view import CueViewKind

MASKS: Mapping[str, CueViewKind] = {
    "cue": "hidden",
    "elsewhere": "hidden_elsewhere",
    "later": "hidden_later",
}
"""What of the image is hidden: the cue, as much of the same frames, the same place in the delay."""

APPEARANCES: Mapping[str, AppearanceSettings] = {
    "light": AppearanceSettings(light=0.6),
    "camera": AppearanceSettings(camera_shift_m=0.03, camera_turn_deg=3.0),
    "table": AppearanceSettings(table_rgb=(0.5, 0.5, 0.5)),
    "hue": AppearanceSettings(hue_deg=10.0),
}
"""Changes that leave each colour nearer to itself than to any other of the nine."""
