"""Actuator networks of files: TorchScript, read as layers that answer as it does."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit

from kernels.actuator_net import ACTIVATIONS
from sim.controllers.formats.network import load_script
from sim.controllers.spec import in_one_line
from sim.robots.robot import ActuatorNetCfg

_TRIED = 64  # drives
Array = NDArray[np.float64]


class ActuatorNet:
    """A network of ``count`` drives in an episode, with layers as :func:`kernels.actuator_net.make_torques` has."""

    def __init__(self, cfg: ActuatorNetCfg, count: int = 0) -> None:
        """Loads the file as data; an error says what is wrong with it."""
        self._cfg = cfg
        try:
            module = load_script(Path(cfg.file), "cpu")
            self._read_layers({name: value.double().numpy() for name, value in module.state_dict().items()}, cfg)
            if not any(self._answers_like(module, index) for index in range(len(ACTIVATIONS))):
                raise ValueError("its layers do not answer as it does")
        except Exception as error:  # a foreign file can fail with anything
            must = f"TorchScript of LSTMs and a dense layer, or of dense layers with {', '.join(ACTIVATIONS)} between"
            raise ValueError(f"actuator_net.file must be {must}, got {cfg.file}: {in_one_line(error)}") from error
        self._begin(count)

    def _read_layers(self, weights: dict[str, Array], cfg: ActuatorNetCfg) -> None:
        lstms = [name for name in weights if "weight_ih" in name]
        names = [*lstms, *(name for name in weights if name.endswith(".weight"))]
        columns = [[weights[name.replace("weight", "bias")], weights[name]] for name in names]
        for layer, name in zip(columns, lstms, strict=False):
            layer[0] = layer[0] + weights[name.replace("weight_ih", "bias_hh")]
            layer.append(weights[name.replace("weight_ih", "weight_hh")])
        self.num_recurrent = len(lstms)
        self.layers = [*map(np.column_stack, columns)]  # the bias first, rows gate by gate of an LSTM
        self.sizes = [len(weights[name]) // (4 if name in lstms else 1) for name in names]
        count = columns[0][1].shape[1]
        ago = cfg.input_idx or tuple(range(count // 2))
        if 2 * len(ago) != count:
            raise ValueError(f"it has {count} inputs, expected input_idx of {count // 2} numbers, got {ago}")
        order = [("pos", "vel").index(part) for part in cfg.input_order.split("_")]
        self.history = 1 + max(ago)
        self.inputs = [2 * steps + part for part in order for steps in ago]
        self._scale = np.repeat([(cfg.pos_scale, cfg.vel_scale)[part] for part in order], len(ago))
        buffers = {name.split(".")[-1]: value.ravel() for name, value in weights.items()}
        self.layers[0][:, 1 : 1 + count] *= self._scale * buffers.get("in_scale", 1.0)
        self.layers[-1] *= cfg.torque_scale * buffers.get("out_scale", 1.0)

    def _begin(self, count: int) -> None:
        self._steps = 0
        self._former = np.zeros((count, 2 * self.history))
        self._state = np.zeros((self.num_recurrent, 2, count, self.sizes[0]))

    @torch.inference_mode()
    def _answers_like(self, module: Any, activation: int) -> bool:
        """Whether the layers, with this activation, answer as their module does in some steps."""
        self.activation = activation
        self._begin(_TRIED)
        state = tuple(torch.zeros((self.num_recurrent, _TRIED, self.sizes[0])) for _ in range(2))
        ours, theirs = [], []
        for error, velocity in np.random.default_rng(0).normal(size=(5, 2, _TRIED)):
            ours.append(self._evaluate(error, velocity))
            inputs = torch.as_tensor(self._former[:, self.inputs] * self._scale, dtype=torch.float32)
            answer, state = module(inputs[:, None], state) if self.num_recurrent else (module(inputs), state)
            theirs.append(self._cfg.torque_scale * answer.double().numpy().reshape(_TRIED))
        return bool(np.allclose(ours, theirs, rtol=0.0, atol=1e-4 * np.abs(theirs).max()))

    def step(self, error: Array, velocity: Array) -> Array:
        """Torques [N m] of a physics step by position errors [rad] and velocities [rad/s], all of one shape."""
        if self._steps % self._cfg.decimation == 0:
            self._torques = self._evaluate(error.ravel(), velocity.ravel()).reshape(error.shape)
        self._steps += 1
        return self._torques

    def _evaluate(self, error: Array, velocity: Array) -> Array:
        self._former = np.column_stack([error, velocity, self._former[:, :-2]])
        x = self._former[:, self.inputs]
        for layer, (hidden, cell) in zip(self.layers, self._state, strict=False):
            i, f, g, o = np.split(layer[:, 0] + np.hstack([x, hidden]) @ layer[:, 1:].T, 4, axis=1)
            cell[:] = expit(f) * cell + expit(i) * np.tanh(g)
            hidden[:] = x = expit(o) * np.tanh(cell)
        activate = getattr(torch.nn.functional, ACTIVATIONS[self.activation])
        for layer in self.layers[self.num_recurrent : -1]:
            x = activate(torch.as_tensor(layer[:, 0] + x @ layer[:, 1:].T)).numpy()
        return (self.layers[-1][:, 0] + x @ self.layers[-1][:, 1:].T)[:, 0]
