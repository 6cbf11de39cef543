"""What evaluates a batch of patches: an onnxruntime session with an explicit provider and explicit threads."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from pointfilter.errors import InvalidModelError, ParameterError, ProviderUnavailableError
from pointfilter.models import ModelBundle
from pointfilter.network import Answers, Network

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

ADAPTIVE_INPUTS = {"patches", "context", "queries", "owners"}
ADAPTIVE_OUTPUTS = ["displacements", "log_errors", "normals"]  # the paper's network has the first one alone
THREADS = "{threads}"  # stands for their number in a provider's options


@dataclass(frozen=True)
class Device:
    """An execution provider of onnxruntime and how it is set up here."""

    provider: str
    options: Mapping[str, str] = field(default_factory=dict)
    """With THREADS for the number of callers."""
    one_call_at_a_time: bool = False
    """The provider's sessions take no calls from several threads at once."""


DEVICES = {
    "cpu": Device("CPUExecutionProvider"),
    "openvino": Device(
        "OpenVINOExecutionProvider", {"device_type": "CPU", "num_of_threads": THREADS, "num_streams": THREADS}
    ),
    "cuda": Device("CUDAExecutionProvider"),
    "tensorrt": Device("TensorrtExecutionProvider"),
    "coreml": Device("CoreMLExecutionProvider"),
    "directml": Device("DmlExecutionProvider", one_call_at_a_time=True),
}
AUTO_ORDER = ("cuda", "cpu")
MAX_THREADS = 1024

# From 1.31 on onnxruntime reports usage to its makers unless told not to. A scan is nobody's business.
onnxruntime.disable_telemetry_events()


class Engine:
    """A bundle as a network (network.Network): patches and queries in, answers out. Safe to call from several threads.

    On a CPU every call runs in its caller's thread; `threads` says how many callers to have (filter_points does it).
    That way no batch waits for another one's slowest layer, and the result cannot depend on the number of threads.
    """

    def __init__(self, bundle: ModelBundle, device: str = "auto", threads: int = 0) -> None:
        """device: auto, or a name in DEVICES; one that was asked for by name and is missing is an error, never a
        silent fallback. threads: 0 takes what the machine, the affinity and the container allow.

        Raises ProviderUnavailableError, ParameterError, InvalidModelError.
        """
        self.bundle = bundle
        self.device = _choose(device)
        chosen = DEVICES[self.device]
        self._turn = threading.Lock() if chosen.one_call_at_a_time else nullcontext()
        if not 0 <= threads <= MAX_THREADS:
            raise ParameterError(
                f"threads must be from 0 to {MAX_THREADS}, got {threads}", limit=MAX_THREADS, actual=threads
            )
        self.threads = threads or available_cpus()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        provider_options = {
            name: str(self.threads) if value == THREADS else value for name, value in chosen.options.items()
        }
        weights = bundle.onnx.read_bytes()  # what is run is what the bundle's sha256 stands for
        if hashlib.sha256(weights).hexdigest() != bundle.sha256:
            raise InvalidModelError(f"model.onnx of {bundle.name!r} changed after it was checked")
        try:
            session = onnxruntime.InferenceSession(
                weights, options, providers=[chosen.provider], provider_options=[provider_options]
            )
        except Exception as error:  # onnxruntime's own tree differs between versions and providers
            raise InvalidModelError(f"onnxruntime cannot load model {bundle.name!r}: {_first_line(error)}") from error
        self.provider: str = session.get_providers()[0]
        if self.provider != chosen.provider:
            raise ProviderUnavailableError(
                f"{chosen.provider} was asked for and {self.provider} came up",
                hint="see the log of onnxruntime for the reason",
            )
        inputs = {entry.name for entry in session.get_inputs()}
        outputs = [entry.name for entry in session.get_outputs()]
        adaptive = bundle.calibration is not None
        if inputs != (ADAPTIVE_INPUTS if adaptive else {"patches"}) or outputs != (
            ADAPTIVE_OUTPUTS if adaptive else ADAPTIVE_OUTPUTS[:1]
        ):
            raise InvalidModelError(f"model {bundle.name!r} has inputs {sorted(inputs)} and outputs {outputs}")
        self._network = session_network(session)

    def __call__(self, patches: Float32, context: Float32, queries: Float32, owners: Int64) -> Answers:
        with self._turn:
            return self._network(patches, context, queries, owners)

    def warm_up(self) -> None:
        """One real inference; raises InvalidModelError when the answer is not what the bundle promises."""
        generator = np.random.default_rng(0)
        patches = generator.uniform(-1, 1, (2, self.bundle.patch_points, 3)).astype(np.float32)
        try:
            answer = self(patches, np.zeros((2, 2), np.float32), np.zeros((2, 3), np.float32), np.arange(2))
        except Exception as error:
            raise InvalidModelError(f"model {self.bundle.name!r} takes no patches: {_first_line(error)}") from error
        for values, width in zip(answer, (3, 2, 3), strict=True):
            if values is not None and (values.shape != (2, width) or not np.isfinite(values).all()):
                raise InvalidModelError(f"model {self.bundle.name!r} answered a test patch with shape {values.shape}")


def session_network(session: onnxruntime.InferenceSession) -> Network:
    """The session of a graph that export wrote, the paper's or an adaptive one, as a network."""
    inputs = {entry.name for entry in session.get_inputs()}

    def ask(patches: Float32, context: Float32, queries: Float32, owners: Int64) -> Answers:
        given = {"patches": patches, "context": context, "queries": queries, "owners": owners}
        return Answers(*session.run(None, {name: given[name] for name in inputs}))

    return ask


def _choose(device: str) -> str:
    present = onnxruntime.get_available_providers()
    if device == "auto":
        device = next(name for name in AUTO_ORDER if DEVICES[name].provider in present)
    if device not in DEVICES:
        raise ParameterError(f"device must be one of auto, {', '.join(DEVICES)}, got {device!r}", actual=device)
    if DEVICES[device].provider not in present:
        raise ProviderUnavailableError(
            f"device {device!r} needs {DEVICES[device].provider}, which this onnxruntime does not have",
            actual=", ".join(present),
            hint="install the onnxruntime build for it, or use device=auto",
        )
    return device


def available_cpus() -> int:
    """CPUs that this process may use: affinity, and the cgroup's quota in a container."""
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
    except (OSError, ValueError):
        return cpus
    return cpus if quota == "max" else max(1, min(cpus, round(int(quota) / int(period))))


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:200] if str(error) else type(error).__name__
