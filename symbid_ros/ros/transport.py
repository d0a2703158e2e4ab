"""How a node's messages travel: by UDP, unless the environment says otherwise."""

from collections.abc import MutableMapping

from symbid_ros.package_paths import config_file

PROFILE, TRANSPORTS = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"
RANGE, LOCALHOST = "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"
OLD_RANGE = "ROS_LOCALHOST_ONLY"  # deprecated; "1" outweighs the others
PEERS = "ROS_STATIC_PEERS"


def use_udp(environment: MutableMapping[str, str], middleware: str) -> None:
    """Have Fast DDS send by UDP alone and not through shared memory as well.

    Who publishes into memory that is shared with a subscriber is held up for seconds when that
    subscriber is killed, and at times hangs for ever (Fast DDS 2.14,
    https://github.com/eProsima/Fast-DDS/issues/6485). A robot's driver must outlive an
    identifier or a recorder.

    What the user has chosen stays: a profile or transports, another middleware, and peers on
    other machines beside the range ``LOCALHOST``, which a profile of the loopback would cut off.

    Parameters
    ----------
    environment : mutable mapping of str to str
        That of the process, before its first node. The discovery range ``LOCALHOST`` is taken
        out of it: the middleware would add shared memory to any profile. The profile that
        replaces it is narrower, its sockets are bound to 127.0.0.1.
    middleware : str
        Name of the RMW implementation.
    """
    is_chosen = environment.get(PROFILE) or environment.get(TRANSPORTS)
    if is_chosen or not middleware.startswith("rmw_fastrtps"):
        return
    if _is_local(environment):
        if environment.get(PEERS):
            return
        environment.pop(RANGE, None)
        environment.pop(OLD_RANGE, None)
        environment[PROFILE] = str(config_file("fastdds_localhost.xml"))
    else:
        environment[PROFILE] = str(config_file("fastdds_udp.xml"))


def _is_local(environment: MutableMapping[str, str]) -> bool:
    return environment.get(OLD_RANGE) == "1" or environment.get(RANGE) == LOCALHOST
