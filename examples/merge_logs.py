"""Identify a robot from several logs, one after the other, without keeping the logs.

python examples/merge_logs.py config/symbitron.urdf bag1 bag2 …
"""

import sys

import symbid_ros as sy


def main(model: str, *bags: str) -> None:
    """Print the total mass and how many parameters are determined after each log."""
    robot = sy.load_model(model)
    options = sy.IdentifyOptions(method="map")
    information = []
    for bag in bags:
        # At most tens of megabytes, however long the log.
        information.append(sy.identify(robot, sy.load_bag(bag, robot), options).information)
        merged = sy.merge(information)
        result = sy.identify(robot, merged, options)
        mass = sum(link.mass for link in result.links.values())
        determined = sum(one.is_determined for one in result.parameters.values())
        print(
            f"with {bag}: {mass:.3f} kg, {determined} of {len(result.parameters)} "
            "single parameters determined"
        )
        merged.save("information.npz")  # for `symbid identify --information`


if __name__ == "__main__":
    main(*sys.argv[1:])
