"""Machine code of the kernel: compiled by Numba once, kept in a file, and called without Numba.

Importing Numba and loading functions from its own cache takes half a second. llvmlite, the compiler
that Numba is built on, loads the same code from an object file in a few milliseconds.
"""

import ctypes
import hashlib
import logging
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.kernel_arrays import (
    LANES,
    STATE,
    WRENCH,
    Loads,
    Motion,
    Tree,
    Windows,
)

logger = logging.getLogger(__name__)

# Environment variable that names a folder for the code, also Numba's.
FOLDER = "NUMBA_CACHE_DIR"
SOURCES = "kernel.py", "kernel_arrays.py", "compiled_kernel.py"

LINE = 8  # numbers in a cache line

# Kinds of the arrays: of a tree, motion, loads and windows, then index, rows, sums, row, phi,
# forces, y, states, scratch and the sizes.
KINDS = "qdddqqqqddddddddqqdd?qqdqddqdddddq"
DTYPES = tuple(map(np.dtype, KINDS))


class CompiledKernel:
    """The kernel's machine code in this process.

    Parameters
    ----------
    content : bytes
        A line of names, then an object file with the code. The first name is that of the function,
        the others are those of functions outside the code.
    """

    def __init__(self, content: bytes) -> None:
        line, _, code = content.partition(b"\n")
        name, *outside = line.decode("ascii").split()
        # The code allocates no memory and raises no errors, so that it never calls the functions
        # of Numba's runtime, which it names.
        unused = ctypes.cast(ctypes.pythonapi.Py_FatalError, ctypes.c_void_p).value
        for one in outside:
            if not llvm.address_of_symbol(one):
                llvm.add_symbol(one, unused)
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target_machine())
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        # A call through ctypes releases the interpreter lock.
        kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(KINDS))
        self._call: Callable[..., None] = kind(self._engine.get_function_address(name))

    def evaluate(
        self,
        tree: Tree,
        motion: Motion,
        loads: Loads,
        windows: Windows,
        *,
        rows: tuple[IntArray, FloatArray],
        sums: FloatArray,
        row: IntArray,
        phi: FloatArray,
        forces: FloatArray,
        y: FloatArray,
    ) -> None:
        """Write rows, their sums over windows, products with parameters, and y.

        Arrays are float64, int64 or bool in C order.

        Parameters
        ----------
        tree, motion, loads, windows
            The robot, N samples and W windows.
        rows : (w,) int64 and (N, c) float64
            Columns of the packed ones in the rows, and the rows; none are written if c is 0.
        sums : (W, w) float64
            Weighted sums of the packed rows over windows; none are written if W is 0.
        row : (w,) int64
            Coordinates of the packed columns.
        phi : (V, w) float64
            Parameters of the packed columns.
        forces : (V, N, n) float64
            Products of the rows with these.
        y : (N, n) float64
            Generalised force of efforts and wrenches.
        """
        index, dense = rows
        links, (count, dof) = len(tree.parent) + 1, y.shape
        states = _aligned(links * STATE * LANES)
        scratch = _aligned((4 + WRENCH + len(index) + dof) * LANES)
        sizes = [count, links - 1, len(loads.link), len(tree.pair_joint), len(windows.weight)]
        sizes += [*sums.shape[:1], len(index), *sums.shape[1:], dense.shape[1], len(phi), dof]
        sizes += [len(scratch), tree.ranked, int(tree.floating)]
        arrays = (
            *(tree.parent, tree.pose, tree.reference, tree.revolute, tree.rank),
            *(tree.pair_start, tree.pair_joint, tree.pair_place),
            *motion,
            *loads,
            *windows,
            *(index, dense, sums, row, phi, forces, y, states, scratch, np.array(sizes)),
        )
        self._call(*_addresses(arrays))


def _aligned(count: int) -> FloatArray:
    """Return an uninitialised array (count,) that begins with a cache line."""
    array = np.empty(count + LINE)
    return array[-array.ctypes.data % (8 * LINE) // 8 :][:count]


def _addresses(arrays: tuple[Any, ...]) -> Iterator[int]:
    """Yield the addresses of arrays; refuse those that the code would misread."""
    for array, dtype in zip(arrays, DTYPES, strict=True):
        if array.dtype != dtype or not array.flags.c_contiguous:
            raise TypeError(f"the kernel needs {dtype} in C order, not {array.dtype}")
        yield array.ctypes.data


@cache
def load_kernel() -> CompiledKernel:
    """Return the kernel, which is compiled if no code for this computer was kept.

    Raises
    ------
    ImportError
        When it must be compiled and Numba cannot be imported.
    """
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    file = f"kernel-{_fingerprint()}.o"
    for folder in _folders():
        if content := _read(folder / file):
            return CompiledKernel(content)
    from symbid_ros.dynamics.kernel import compile_to_llvm  # noqa: PLC0415 - Numba loads slowly

    writable = (folder for folder in _folders() if _is_writable(folder))
    kept_in = next(writable, None)
    logger.warning(
        "compiling the regressor for this computer: some 10 s, %s",
        f"once (kept in {kept_in})"
        if kept_in
        else f"at every start, because no folder can be written; set {FOLDER}",
    )
    assembly, name = compile_to_llvm(KINDS)
    module = llvm.parse_assembly(assembly)
    outside = (one.name for one in module.functions if one.is_declaration)
    names = [name, *(one for one in outside if not one.startswith("llvm."))]
    content = " ".join(names).encode("ascii") + b"\n" + _target_machine().emit_object(module)
    if kept_in is not None:
        with suppress(OSError):  # the disk may be full
            _write(kept_in / file, content)
    return CompiledKernel(content)


def _target_machine() -> llvm.TargetMachine:
    """Return the compiler for this computer's processor, with Numba's settings."""
    target = llvm.Target.from_default_triple()
    machine: llvm.TargetMachine = target.create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        codemodel="jitdefault",
        jit=True,
    )
    return machine


def _fingerprint() -> str:
    """Return a checksum of all that the machine code depends on."""
    parts = [llvmlite.__version__, llvm.get_process_triple(), llvm.get_host_cpu_name()]
    digest = hashlib.sha256("|".join(parts).encode())
    digest.update(llvm.get_host_cpu_features().flatten().encode())
    for name in SOURCES:
        digest.update((resources.files(__package__) / name).read_bytes())
    return digest.hexdigest()[:24]


def _folders() -> tuple[Path, ...]:
    """Return the folders in which the code may be kept, best first."""
    if chosen := os.environ.get(FOLDER):
        return (Path(chosen),)
    home = {
        "darwin": "~/Library/Caches",
        "win32": os.environ.get("LOCALAPPDATA", "~/AppData/Local"),
    }.get(sys.platform, os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    return Path(__file__).parent / "__pycache__", Path(home).expanduser() / "symbid_ros"


def _is_writable(folder: Path) -> bool:
    """Return whether files can be written to a folder, which is made if it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _read(file: Path) -> bytes | None:
    """Return the content of a file, or None if the file is missing or damaged."""
    try:
        checksum, _, content = file.read_bytes().partition(b"\n")
    except OSError:
        return None
    return content if checksum.decode("latin-1") == _checksum(content) else None


def _write(file: Path, content: bytes) -> None:
    """Write a file at once, because another process may read it."""
    with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as part:
        part.write(_checksum(content).encode("ascii") + b"\n" + content)
    Path(part.name).replace(file)


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
