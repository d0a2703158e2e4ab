"""Identify a legged robot from a bag: check the log, identify, save.

symbid simulate --out bag
python examples/legged_from_bag.py bag config/symbitron.urdf result
"""

import sys

import symbid_ros as sy


def main(bag: str, model: str, out: str) -> None:
    """Identify, print the verdict and write the estimate and the identified models."""
    robot = sy.load_model(model)
    log = sy.load_bag(bag, robot)

    diagnosis = sy.diagnose(robot, log)
    for finding in diagnosis.findings:
        print(f"{finding.severity.name.lower()}: {finding.message}")

    result = sy.identify(robot, log)
    for alarm in result.alarms:
        print(f"alarm: {alarm}")
    for link in result.links.values():
        mass = result.parameters[f"{link.name}/m"]
        print(f"{link.name}: {mass.value:.2f} ± {mass.std:.2f} kg")
    print(f"written to {result.save(out)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
