"""Controllers in ONNX files: data alone, from one file, run by onnxruntime."""

import hashlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

PRODUCER = "faultline"
"""Who wrote a file, as the file says; ours carry a checksum."""
_CHECKSUM = "faultline_sha256"
_EXPORT = "write it from its rsl_rl checkpoint by `faultline export-policy`"
_CPU, _CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"


class OnnxPolicy:
    """A controller that onnxruntime runs: where the observations are if it can, else on the CPU, with copies."""

    def __init__(self, session: Any, sizes: tuple[int, int], device: torch.device) -> None:
        """Take over a session.

        Args:
            session: An ``onnxruntime.InferenceSession`` with one float32 input and one float32 output.
            sizes: Observation and action size.
            device: Where the session computes.
        """
        self.sizes = sizes
        self.device = device
        self._session = session
        self._input, self._output = session.get_inputs()[0].name, session.get_outputs()[0].name

    def __call__(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions (num_envs, num_joints) on the device of the observations (num_envs, observation_size).

        Raises:
            Exception: One of onnxruntime's own, if the graph does not take these rows.
        """
        rows = observation.detach().to(self.device, torch.float32).contiguous()
        action = torch.empty((len(rows), self.sizes[1]), device=self.device)
        binding = self._session.io_binding()
        for bind, name, tensor in (
            (binding.bind_input, self._input, rows),
            (binding.bind_output, self._output, action),
        ):
            bind(name, self.device.type, self.device.index or 0, np.float32, tuple(tensor.shape), tensor.data_ptr())
        if self.device.type == "cuda":  # it has a stream of its own: ours must be done before, and it waits at its end
            torch.cuda.current_stream(self.device).synchronize()
        self._session.run_with_iobinding(binding)
        return action.to(observation.device)


def load_onnx(path: Path, sizes: tuple[int, int] | None, device: str) -> OnnxPolicy:
    """Load a controller from an ONNX file.

    Nothing but that file is read and no code in it runs: weights beside it are refused, and onnxruntime knows only its
    own operators. It is read by onnxruntime's C++, which a file made to harm can crash.

    Args:
        path: The file; its graph takes observations (batch, observation_size) and gives actions (batch, num_joints),
            both float32, for any batch.
        sizes: Observation and action size of the robot; None takes whatever the file has.
        device: Torch device name; on CUDA the graph runs on the GPU if onnxruntime is built for it, else on the CPU.

    Raises:
        ValueError: If the file is damaged or foreign, its input or output does not fit, or onnxruntime is missing.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"policy '{path}' cannot be read: {error.strerror or error}: put a copy of it there") from None
    return onnx_policy(data, str(path), sizes, device)


def onnx_policy(data: bytes, name: str, sizes: tuple[int, int] | None, device: str) -> OnnxPolicy:
    """The controller in the bytes of an ONNX file, as :func:`load_onnx` reads them; ``name`` is what errors call it."""
    _check_file(data, name)
    where = torch.device(device)
    session = _open_session(data, name, where)
    sizes = _checked_sizes(session, name, sizes)
    if where.type == "cuda" and session.get_providers()[0] != _CUDA:
        warnings.warn(
            f"policy '{name}' runs on the CPU, with copies to and from {device} every control step: this onnxruntime "
            "has no CUDA that works; install onnxruntime-gpu, or give the rsl_rl checkpoint",
            stacklevel=2,
        )
        where = torch.device("cpu")
    return OnnxPolicy(session, sizes, where)


def _libraries(name: str) -> tuple[Any, Any]:
    """The modules onnx and onnxruntime, which only controllers of this kind need."""
    try:
        import onnx
        import onnxruntime
    except ImportError as error:
        raise ValueError(
            f"policy '{name}' needs onnx and onnxruntime, but: {error}; `pip install onnx onnxruntime` "
            "(onnxruntime-gpu to run it on the GPU), or give the controller as an rsl_rl checkpoint"
        ) from None
    return onnx, onnxruntime


def seal(model: Any) -> bytes:
    """An ``onnx.ModelProto`` as the bytes of a file, with a checksum over all of them.

    Serialised messages add up: the checksum is one more piece of metadata, and ends the file.
    """
    model.producer_name = PRODUCER
    body = model.SerializeToString(deterministic=True)
    return body + _closing(type(model), hashlib.sha256(body).hexdigest())


def _closing(kind: Any, checksum: str) -> bytes:
    end = kind()
    end.metadata_props.add(key=_CHECKSUM, value=checksum)
    return end.SerializeToString(deterministic=True)


def _check_file(data: bytes, name: str) -> None:
    """Raises ValueError for a file that is no ONNX model, is damaged, or keeps weights in another file."""
    onnx, _ = _libraries(name)
    try:
        model = onnx.ModelProto.FromString(data)
    except Exception as error:  # protobuf has its own, and gives them up to change
        raise ValueError(f"policy '{name}' is no whole ONNX file (truncated or foreign): {error}; {_EXPORT}") from None
    if not model.graph.node:
        raise ValueError(f"policy '{name}' is no ONNX file: expected a graph, found none; {_EXPORT}")
    sums = [entry.value for entry in model.metadata_props if entry.key == _CHECKSUM]
    if sums or model.producer_name == PRODUCER:
        closing = _closing(type(model), sums[-1] if sums else "")
        body = data.removesuffix(closing)
        if len(sums) != 1 or body == data or hashlib.sha256(body).hexdigest() != sums[0]:
            raise ValueError(
                f"policy '{name}' does not have its checksum: it is damaged, or another tool changed it (which must "
                f"then take out the producer '{PRODUCER}' and the metadata '{_CHECKSUM}'): put a copy of it back"
            )
    outside = [tensor for tensor in _tensors(model) if tensor.external_data or tensor.data_location]
    if outside:
        raise ValueError(
            f"policy '{name}' keeps {len(outside)} of its tensors in another file ('{outside[0].name}' first), "
            f"expected all in this one: save it anew with onnx.save(..., save_as_external_data=False), or {_EXPORT}"
        )


def _tensors(message: Any) -> Iterator[Any]:
    """Every tensor anywhere in a model: weights, attributes, and those of subgraphs and functions."""
    if message.DESCRIPTOR.full_name == "onnx.TensorProto":
        yield message
        return
    for field, value in message.ListFields():
        if field.message_type is not None:
            for inner in [value] if hasattr(value, "DESCRIPTOR") else value:
                yield from _tensors(inner)


def _open_session(data: bytes, name: str, device: torch.device) -> Any:
    _, onnxruntime = _libraries(name)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()  # one in worker processes, as prepare_torch has it
    options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what is wrong comes as an exception
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    providers: list[Any] = [_CPU]
    if device.type == "cuda" and _CUDA in onnxruntime.get_available_providers():
        # TF32 would round every product to 10 bits.
        providers = [(_CUDA, {"device_id": str(device.index or 0), "use_tf32": "0"}), _CPU]
    try:
        return onnxruntime.InferenceSession(data, options, providers=providers, enable_fallback=0)
    except Exception as error:  # onnxruntime's errors have no base of their own; bytes that are no UTF-8 give another
        raise ValueError(
            f"policy '{name}' is refused by onnxruntime {onnxruntime.__version__}: {error}; {_EXPORT}"
        ) from None


def _checked_sizes(session: Any, name: str, sizes: tuple[int, int] | None) -> tuple[int, int]:
    """Widths of input and output; refuses a graph that is not one batch of float32 rows of these sizes to another."""
    widths: list[Any] = []
    for kind, ports in (("input", session.get_inputs()), ("output", session.get_outputs())):
        if len(ports) != 1:
            named = ", ".join(port.name for port in ports)
            raise ValueError(
                f"policy '{name}' must have one {kind}, got {len(ports)} ({named}): a controller with a state of its "
                "own goes in as module:callable"
            )
        port = ports[0]
        shape = list(port.shape or [None, None])  # an output's may be unknown: it is tried afterwards
        if port.type != "tensor(float)" or len(shape) != 2:
            raise ValueError(
                f"policy '{name}' must have an {kind} of shape (batch, size) and type float32, got '{port.name}' of "
                f"shape {shape} and type {port.type}; {_EXPORT}"
            )
        if isinstance(shape[0], int):
            raise ValueError(
                f"policy '{name}' has a fixed batch size of {shape[0]} ({kind} '{port.name}' of shape {shape}), "
                f"expected a free one, since it is asked for many robots at once: export it with a dynamic first axis, "
                f"or {_EXPORT}"
            )
        widths.append(shape[1])
    if sizes is None:
        if not all(isinstance(got, int) for got in widths):
            raise ValueError(f"policy '{name}' does not say how wide its rows are, got {widths}: save it with sizes")
        return widths[0], widths[1]
    if any(isinstance(got, int) and got != size for got, size in zip(widths, sizes, strict=True)):
        found = [got if isinstance(got, int) else "any number of" for got in widths]
        raise ValueError(
            f"policy '{name}' maps {found[0]} observations to {found[1]} actions, but this robot has {sizes[0]} "
            f"observations and {sizes[1]} joints: use a controller of this robot"
        )
    return sizes
