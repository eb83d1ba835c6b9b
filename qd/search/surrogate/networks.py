"""The surrogate's networks and their training; on CUDA a step is one launch of a captured graph."""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from sim.device import recording
from sim.terrains.corridor import SHAPE

MEMBERS = 4
"""Networks of the ensemble. Each begins with weights of its own, and learns from draws of its own."""
_CONVOLUTIONS = ((5, (3, 3), 12), (3, (2, 2), 24), (3, (2, 1), 32))  # size, strides across and along the way, channels
_FEATURES = 64  # of each position along the way
_WAVES = 4  # cosines that encode a position
_EAGER_STEPS = 3  # before the capture: they allocate the optimiser's state and choose the convolutions' kernels
_LEARNING_RATE, _WEIGHT_DECAY = 1e-3, 1e-2
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # of Adam

Moments = list[dict[str, Tensor]]
"""What Adam remembers of each tensor of weights: `step`, `exp_avg` and `exp_avg_sq`; nothing before its first step."""
_Layers = tuple[tuple[Tensor, Tensor], ...]


class Networks(nn.Module):
    """Small convolutional networks side by side, each of which maps ``num_maps`` maps to ``num_out`` numbers.

    Convolutions slide along the way, and mean and maximum pool what they find, so that an obstacle is the same wherever
    it lies. The last convolution also sees the position along the way, as cosines, from which networks learn in fewer
    steps than from one coordinate. Parameters are weights and biases of each layer in turn, all zero, of shapes
    (MEMBERS * out, in, *size) and (MEMBERS * out,), in the layout of memory in which convolutions are fastest.
    """

    def __init__(self, num_maps: int, num_out: int) -> None:
        super().__init__()
        (rows, cols), channels = SHAPE, num_maps
        layers, self._weights = [], nn.ParameterList()
        for size, strides, channels_out in _CONVOLUTIONS:
            layers.append((channels_out, channels, size, size))
            rows, cols, channels = -(-rows // strides[0]), -(-cols // strides[1]), channels_out
        for out, *shape in (*layers, (_FEATURES, channels + _WAVES, rows, 3), (num_out, 2 * _FEATURES, 1, 1)):
            weights = torch.zeros(MEMBERS * out, *shape).contiguous(memory_format=torch.channels_last)
            self._weights.extend([weights, torch.zeros(MEMBERS * out)])
        waves = math.pi * torch.arange(1, _WAVES + 1)[:, None] * torch.linspace(0.0, 1.0, cols)  # from start to goal
        positions = nn.functional.unfold(waves.cos()[None, :, None].repeat(1, 1, rows, 1), (rows, 3), padding=(0, 1))
        self.register_buffer("_positions", positions[0], persistent=False)

    def forward(self, maps: Tensor) -> Tensor:
        """Outputs of each network, (batch, MEMBERS, num_out), for its maps of (MEMBERS, batch, *SHAPE, num_maps)."""
        if maps.is_cuda:
            return self._through(maps.movedim(0, 3).flatten(3), *self._layers(MEMBERS))
        # One by one, since channels that no weight joins cost time on the CPU.
        return torch.cat([*map(self._through, maps, self._layers(1))], dim=1)

    def judge(self, maps: Tensor) -> Tensor:
        """Outputs as of :meth:`forward`, float32, for the same maps (batch, *SHAPE, num_maps); on CUDA in half."""
        if not maps.is_cuda:
            return self(maps.expand(MEMBERS, -1, -1, -1, -1))
        return self._through(maps.half(), *self._layers(MEMBERS))

    def _layers(self, count: int) -> list[_Layers]:
        """Weights and biases of each layer, in blocks of ``count`` networks."""
        blocks = [tensor.unflatten(0, (MEMBERS, -1)).split(count) for tensor in self._weights]
        return [tuple(zip(tensors[::2], tensors[1::2], strict=True)) for tensors in zip(*blocks, strict=True)]

    def _through(self, maps: Tensor, layers: _Layers) -> Tensor:
        """Outputs of some networks for maps of each or of all, shape (batch, networks, num_out)."""
        rows, convolutions = maps.movedim(-1, 1), [*zip(_CONVOLUTIONS, layers, strict=False)]
        if maps.is_cuda:
            (_, strides, _), (weight, bias) = convolutions.pop(0)
            rows = _slide_over(rows, weight.to(rows.dtype), bias.to(rows.dtype), strides)
        for (size, strides, _), (weight, bias) in convolutions:
            weight = _block_diagonal(weight).to(rows.dtype)
            rows = _activated(rows, weight, bias.flatten().to(rows.dtype), strides, size // 2)
        (weight, bias), (last_weight, last_bias) = layers[-2:]
        weight, position_weight = weight.split([weight.shape[2] - _WAVES, _WAVES], dim=2)
        offsets = position_weight.flatten(2) @ self.get_buffer("_positions") + bias[..., None]  # the same in every row
        rows = nn.functional.conv2d(rows, _block_diagonal(weight).to(rows.dtype), padding=(0, 1))
        rows = (rows.reshape(len(rows), *offsets.shape) + offsets.to(rows.dtype)).relu()
        pooled = torch.cat([rows.mean(-1), rows.amax(-1)], dim=2).float()
        return torch.einsum("bni,noi->bno", pooled, last_weight.flatten(2)) + last_bias


def _activated(rows: Tensor, weight: Tensor, bias: Tensor, strides: tuple[int, int], padding: int) -> Tensor:
    """A convolution and a ReLU; in half precision one kernel of cuDNN does both, without gradients."""
    if rows.dtype != torch.half:
        return nn.functional.conv2d(rows, weight, bias, strides, padding).relu()
    return torch.cudnn_convolution_relu(rows, weight, bias, strides, (padding, padding), (1, 1), 1)


def _slide_over(rows: Tensor, weight: Tensor, bias: Tensor, strides: tuple[int, int]) -> Tensor:
    """The first convolution and a ReLU, as products of matrices: for so few channels cuDNN's kernels are slow.

    Rows of networks are channels, maps of each behind the others'; or all networks have the same maps.
    """
    size, num_maps = weight.shape[-1], weight.shape[2]
    missing = -size % 8  # Tensor Cores take eight numbers at once
    weight = nn.functional.pad(weight, (0, missing))
    rows = nn.functional.pad(rows, (size // 2, size // 2 + missing, size // 2, size // 2)).unflatten(1, (-1, num_maps))
    windows = rows.unfold(3, size, strides[0]).unfold(4, size + missing, strides[1]).permute(0, 1, 3, 4, 2, 5, 6)
    num_sets, *positions = windows.shape[1:4]  # sets of maps, of one network or of all
    columns = windows.flatten(4).flatten(2, 3)
    weight, bias = weight.flatten(2).reshape(num_sets, -1, columns.shape[-1]), bias.reshape(num_sets, -1)
    if num_sets == 1:
        found = nn.functional.linear(columns[:, 0], weight[0], bias[0])
    else:
        found = (columns @ weight.mT + bias[:, None]).movedim(1, 2).flatten(2)
    return found.relu().unflatten(1, positions).movedim(-1, 1)


def _block_diagonal(weight: Tensor) -> Tensor:
    """Weights of networks as those of one convolution, whose groups would be slower."""
    count = len(weight)
    if count == 1:
        return weight[0]
    apart = torch.eye(count, device=weight.device)[:, None, :, None, None, None] * weight[:, :, None]
    return apart.flatten(2, 3).flatten(0, 1).contiguous(memory_format=torch.channels_last)


class Trainer:
    """Steps of AdamW that read and write fixed memory, so that CUDA can repeat one of them as a graph.

    Networks that are moved need a new trainer. On CUDA all steps must be taken on one stream, other than the default
    one. ``loss`` takes outputs and targets, both of shape (batch, MEMBERS, num_out).
    """

    def __init__(
        self, networks: Networks, loss: Callable[[Tensor, Tensor], Tensor], device: str, moments: Moments | None = None
    ) -> None:
        self._networks, self._loss, self._on_cuda = networks, loss, device.startswith("cuda")
        weights = list(networks.parameters())
        networks.zero_grad(set_to_none=True)
        self._optimiser = torch.optim.AdamW(
            weights, lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY, capturable=self._on_cuda, fused=True
        )
        for tensor, remembered in zip(weights, moments or [{} for _ in weights], strict=True):
            if remembered:  # Adam begins anew where there is nothing
                likes = tensor.new_zeros(()), tensor, tensor  # a moment's memory is laid out as that of its weights
                self._optimiser.state[tensor] = {
                    name: torch.empty_like(like).copy_(remembered[name])
                    for name, like in zip(_MOMENTS, likes, strict=True)
                }
        self._batch: tuple[Tensor, Tensor] | None = None  # maps and targets
        self._graph: torch.cuda.CUDAGraph | None = None
        self._eager_steps = 0

    @property
    def moments(self) -> Moments:
        """What Adam remembers of each tensor of weights."""
        state = self._optimiser.state
        weights = self._networks.parameters()
        return [{name: state[tensor][name] for name in _MOMENTS if tensor in state} for tensor in weights]

    def run(self, maps: Tensor, targets: Tensor, drawn: Tensor, turned: Tensor) -> None:
        """Takes a step for each batch that was drawn. All tensors are on the device.

        Maps of all terrains are of half precision, shape (N, *SHAPE, num_maps); targets have shape (N, num_out). Which
        are ``drawn`` in each step for each network, and whether mirrored, ``turned``, are (steps, batch, MEMBERS).
        """
        terrains, turned = drawn.transpose(1, 2), turned.transpose(1, 2)
        if self._batch is None:  # memory of a batch, the same in every step
            shape = terrains.shape[1:]
            self._batch = maps.new_empty(*shape, *maps.shape[1:]), targets.new_empty(*shape, targets.shape[1])
        batch_maps, batch_targets = self._batch
        # A mirrored terrain has the lines along the way in the opposite order.
        lines = torch.arange(SHAPE[0], device=maps.device)
        rows = torch.where(turned[..., None], lines.flip(0), lines) + len(lines) * terrains[..., None]
        for step_rows, step_terrains in zip(rows.int().flatten(1), terrains.flatten(1), strict=True):
            # Outside of the graph, since they are drawn from ever more terrains.
            torch.index_select(maps.flatten(0, 1), 0, step_rows, out=batch_maps.flatten(0, 2))
            torch.index_select(targets, 0, step_terrains, out=batch_targets.flatten(0, 1))
            self._take_step(batch_maps, batch_targets)

    def _take_step(self, maps: Tensor, targets: Tensor) -> None:
        """A step on the batch that lies in fixed memory."""
        if not self._on_cuda or self._eager_steps < _EAGER_STEPS:
            self._learn_batch(maps, targets)
            self._eager_steps += 1
            return
        if self._graph is None:
            self._optimiser.zero_grad(set_to_none=True)  # so that the graph has gradients of its own
            graph = torch.cuda.CUDAGraph()
            # Other threads may use the device meanwhile.
            stream = torch.cuda.current_stream()
            with recording(), torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self._learn_batch(maps, targets)  # is recorded, not done
            self._graph = graph
        self._graph.replay()

    def _learn_batch(self, maps: Tensor, targets: Tensor) -> None:
        self._optimiser.zero_grad(set_to_none=True)
        self._loss(self._networks(maps.float()), targets.transpose(0, 1)).backward()
        self._optimiser.step()
