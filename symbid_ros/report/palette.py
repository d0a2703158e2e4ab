"""Colours of a robot's links and inertias, which colour-blind readers see alike."""

# cividis from 0.3 to 1, which gets lighter evenly, by the number of determined parameters.
DETERMINED_COLOURS = (
    "#4f576c",
    "#5f636f",
    "#6f7073",
    "#7e7d78",
    "#908b78",
    "#a19975",
    "#b4a76f",
    "#c6b667",
    "#dac65b",
    "#eed649",
    "#fee838",
)
UNKNOWN_COLOUR = "#a8a8a8"
# Vermillion and reddish purple of Okabe and Ito's palette.
BEFORE_COLOUR = CHANGED_COLOUR = "#d55e00"
UNCERTAINTY_COLOUR = "#cc79a7"


def link_colour(determined: int | None) -> str:
    """Return the colour of a link by the number of its ten parameters that the data determine."""
    return UNKNOWN_COLOUR if determined is None else DETERMINED_COLOURS[determined]


def rgb(colour: str) -> tuple[float, float, float]:
    """Return red, green and blue from 0 to 1 of a colour such as ``#d55e00``."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red / 255, green / 255, blue / 255
