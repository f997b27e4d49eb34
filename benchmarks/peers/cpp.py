"""Our algorithm as a C++ compiler builds it for this machine: ``g++ -O3 -march=native`` at first use."""

import ctypes
import shutil
import subprocess
import tempfile
from hashlib import sha256
from pathlib import Path

import numpy as np

from hingesplat.camera import Camera
from hingesplat.render.numba_backend import _view
from hingesplat.render.torch_backend import TRANSMITTANCE_MIN

SOURCE = Path(__file__).with_name("engine.cpp")
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fno-finite-math-only", "-std=c++17", "-fPIC", "-w")
"""The liberties with floating point that our kernels take, too: not those that assume away NaN. Only for compiling:
linked with them, a library rounds the smallest numbers of the whole process to 0 as soon as it is loaded, and some of
SciPy's trees then crash."""


def why_not() -> str | None:
    """Why it cannot run here; None where it can."""
    return None if shutil.which("g++") else "there is no g++"


def _library() -> ctypes.CDLL:
    """Build it, or take what an earlier run built from the same source on the same machine."""
    version = subprocess.run(["g++", "--version"], capture_output=True, check=True).stdout
    cpu = Path("/proc/cpuinfo")
    processor = cpu.read_bytes().split(b"\n\n")[0] if cpu.is_file() else b""
    flags = [line for line in processor.splitlines() if line.startswith(b"flags")]
    digest = sha256(b"\n".join([SOURCE.read_bytes(), " ".join(FLAGS).encode(), version, *flags])).hexdigest()[:16]
    target = Path(tempfile.gettempdir()) / f"hingesplat-engine-{digest}.so"
    if not target.is_file():
        with tempfile.TemporaryDirectory() as folder:
            compiled, made = Path(folder) / "engine.o", Path(folder) / "engine.so"
            subprocess.run(["g++", *FLAGS, "-c", "-o", str(compiled), str(SOURCE)], check=True)
            subprocess.run(["g++", "-shared", "-o", str(made), str(compiled)], check=True)
            shutil.move(made, target)
    library = ctypes.CDLL(str(target))
    pointer, whole, real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_float
    library.make.restype = pointer
    library.drop.argtypes = [pointer]
    library.forward.argtypes = [pointer, whole, *[pointer] * 7, real, pointer]
    library.backward.argtypes = [pointer] * 11
    return library


class Rasteriser:
    """See the package; buffers are kept from call to call, so one backward a forward."""

    def __init__(self, n: int, camera: Camera) -> None:
        self.library, self.camera = _library(), camera
        self.context, self.view = self.library.make(), _view(camera)
        self.inputs: tuple[np.ndarray, ...] = ()

    def __del__(self) -> None:
        self.library.drop(self.context)

    def forward(self, *inputs: np.ndarray) -> np.ndarray:
        self.inputs = inputs
        image = np.empty((5, self.camera.height, self.camera.width), np.float32)
        background, n = np.zeros(3, np.float32), len(inputs[0])
        arrays = [a.ctypes.data for a in (*inputs, self.view, background)]
        self.library.forward(self.context, n, *arrays, TRANSMITTANCE_MIN, image.ctypes.data)
        return image

    def backward(self, g_image: np.ndarray) -> list[np.ndarray]:
        gradients = [np.empty_like(a) for a in self.inputs]
        arrays = (*self.inputs[:4], g_image, *gradients)
        self.library.backward(self.context, *(a.ctypes.data for a in arrays))
        return gradients
