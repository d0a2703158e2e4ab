"""Memory and time of identifying a long log, which is read slice by slice.

One simulated Symbitron log is repeated with later stamps up to the requested length, and identified
in its own process. The table shows the time and the peak memory.

    .venv/bin/python bench/long_log.py [--minutes 2 20 60]

Takes about 12 s and 30 MB of disk per minute of log.
"""

import argparse
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from process_usage import peak_memory

from symbid_ros.bags import BagWriter
from symbid_ros.bags.container.files import read_blocks
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.types import fill_stamp, read_stamp
from symbid_ros.offline.bags import BagRequest
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

MODEL = config_file("symbitron.xml")


def lengthened(log: Path, out: Path, minutes: float) -> None:
    """Repeat the sensor messages of a log until they last ``minutes``."""
    decoders: dict[str, TopicDecoder] = {}
    for block in read_blocks([log]):
        for topic, spans in block.spans.items():
            if "ground_truth" not in topic.name:
                decoder = decoders.setdefault(topic.name, TopicDecoder(str(log), topic))
                decoder.add(block.data, spans)
    pieces = {name: decoder.batches for name, decoder in decoders.items()}
    stamps = {name: [read_stamp(p.records) for p in parts] for name, parts in pieces.items()}
    length = max(int(part[-1]) for parts in stamps.values() for part in parts)
    with BagWriter(out) as bag:
        channels = {
            name: bag.add_topic(name, decoder.topic.msgtype) for name, decoder in decoders.items()
        }
        for round_number in range(int(np.ceil(minutes * 60e9 / length))):
            for number in range(len(next(iter(pieces.values())))):
                for name, parts in pieces.items():
                    piece, stamp = parts[number], stamps[name][number] + round_number * length
                    fill_stamp(piece.layout.columns(piece.records), stamp)
                    for row, at in enumerate(stamp.tolist()):
                        bag.write(channels[name], at, piece.records[row].tobytes())


def identify(bag: Path) -> tuple[float, float]:
    """Return duration, s, and peak memory, MB, of one identification."""
    start = time.perf_counter()
    options = IdentifyOptions(prior_percent=25.0, method="map")
    BagRequest((bag,), MODEL, options).load().solve()
    return time.perf_counter() - start, peak_memory()


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, nargs="+", default=[2.0, 20.0, 60.0])
    arguments = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    print("minutes   MB of bag       s   peak MB")
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        record(Simulator(SimulateOptions(moves=20, motion_seed=1, noise_seed=2)), log)
        for minutes in arguments.minutes:
            bag = Path(folder) / "long"
            lengthened(log, bag, minutes)
            size = sum(file.stat().st_size for file in bag.iterdir()) * 1e-6
            with ProcessPoolExecutor(1, mp_context=spawn) as pool:
                took, peak = pool.submit(identify, bag).result()
            print(f"{minutes:7g} {size:11.0f} {took:7.0f} {peak:9.0f}", flush=True)
            for file in bag.iterdir():
                file.unlink()
            bag.rmdir()


if __name__ == "__main__":
    main()
