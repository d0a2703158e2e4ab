"""Names the links of a model file that no physical body can be."""

from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.tree import RobotModel


def impossible_links(model: RobotModel) -> tuple[str, ...]:
    """Return the moving links whose inertia no mass density has; massless ones are possible."""
    moving = model.links[0 if model.floating else 1 :]
    return tuple(link.name for link in moving if not link.virtual and not is_consistent(link.phi))


def describe_impossible_links(model: RobotModel) -> str:
    """Return a sentence that names these links and says what becomes of them; empty if none."""
    names = impossible_links(model)
    if not names:
        return ""
    which = f"link {names[0]} is" if len(names) == 1 else f"links {', '.join(names)} are"
    return (
        f"{model.source}: {which} physically impossible: a principal moment of inertia is negative "
        "or exceeds the sum of the other two, or the mass is not positive; the prior is around "
        "these values, and `method` map_lmi identifies possible links near them; correct their "
        "<inertial>"
    )
