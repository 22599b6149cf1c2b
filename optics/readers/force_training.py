"""Training of the two networks of optics.readers.force_learning, on a processor, in PyTorch.

    model = train(features, Plan("scaled", bins=9), "model.npz.part")

`published` is trained as in the source: Nadam with a rate of 1e-3, 100 presses at a time, dropout of 10 % in each
hidden layer, 20 % of the presses for the test, 10 % of the rest for validation; it ends after 50 epochs without a
smaller aRMSE (13) of the validation. Three things are chosen here. Inputs are scaled to mean 0 and standard deviation
1. First weights are Glorot's for logistic functions. The loss of 100 presses is the root mean square over them and all
bins: (13), which takes a root for each bin, sees about one press in each and none in a third of them; with it a
network of 400 units calls 0 everywhere and does not leave that in 40 epochs.

`scaled` differs in the loss, cross entropy of the shares and squared error of the total force over (0.06 N)^2, the
resolution of the source's force sensor, and in noise that is added to the motion of each bin, as optical flow has it.

The state is written to a file as training goes on. The same call resumes from it, at the end of the last epoch that was
written, and comes to the same result: what is random depends on seed and epoch alone. It is the same bit by bit on the
same machine with as many threads (OMP_NUM_THREADS).
Needs PyTorch: pip install tactile-optics[learn]."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optics.files.output import replacing
from optics.readers.force_learning import BadFeatures, FeatureSet, ForceModel, labels, split

RESOLUTION = 0.06  # N: of the source's force sensor
BATCH = 100  # presses
RATE = 1e-3  # of Nadam
DROPOUT = 0.1  # of published
LOGISTIC = 4.0  # times the first weights before a logistic function: Glorot & Bengio, AISTATS 2010
LAYERS = {"published": 3, "scaled": 2}  # hidden ones
WIDTH = {"published": 1600, "scaled": 512}
SAVED_EVERY = 20.0  # s


@dataclass(frozen=True)
class Plan:
    """What is trained.

    kind    "published" or "scaled";   bins  n = bins x bins of the face
    epochs  at most;   patience  epochs without a smaller validation loss after which it ends
    noise   px rms, added to the mean motion of each bin in training (`scaled`)
    seed    of split, first weights, order and noise
    width   units of each hidden layer; 0: 1600 of `published`, 512 of `scaled`"""

    kind: str
    bins: int = 9
    seed: int = 0
    epochs: int = 1000
    patience: int = 50
    noise: float = 0.02
    width: int = 0

    def __post_init__(self) -> None:
        if self.kind not in LAYERS:
            raise ValueError(f"a network of the kind '{self.kind}'; allowed: {', '.join(LAYERS)}")
        if self.bins < 1 or self.epochs < 1 or self.patience < 1 or not 0 <= self.noise < 100:
            raise ValueError(
                f"bins = {self.bins}, epochs = {self.epochs}, patience = {self.patience}, noise = {self.noise:g} px; "
                "allowed: whole numbers from 1 on, a noise from 0 to 100 px"
            )
        if self.seed < 0 or not 0 <= self.width <= 10_000:
            raise ValueError(f"seed = {self.seed}, width = {self.width}; allowed: a seed from 0 on, 0 to 10,000 units")


def _torch() -> Any:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "training a network needs PyTorch, which is not installed; next step: pip install tactile-optics[learn]"
        ) from error
    return torch


def train(
    one: FeatureSet,
    plan: Plan,
    state_file: str | Path,
    start: ForceModel | None = None,
    say: Callable[[str, int, int], None] | None = None,
) -> ForceModel:
    """The map with the smallest loss in the validation. `state_file` is kept up to date and removed in the end.

    start   a map of the same kind and size whose weights are the first ones: trained again, for another sensor
    say     called with what, epochs done, epochs at most

    Raises BadFeatures where the state file is of another training or `start` of another kind."""
    torch = _torch()
    parts = [torch.from_numpy(rows) for rows in split(len(one), plan.seed)[:2]]
    x = one.vectors(plan.kind)
    y = torch.from_numpy(labels(one.place, one.force, plan.bins, one.face))
    mean, scale = np.zeros(x.shape[1], np.float32), np.ones(x.shape[1], np.float32)
    if start is not None:
        wanted = (plan.kind, plan.bins, one.bins)
        if (start.kind, start.bins, start.features) != wanted:
            raise BadFeatures(
                f"the map to start from is {start.kind} of {start.bins} x {start.bins} bins on {start.features}; "
                f"allowed: {plan.kind} of {plan.bins} x {plan.bins} on {one.bins}"
            )
        mean, scale = start.mean, start.scale
    elif plan.kind == "published":
        own = x[parts[0].numpy()]
        mean, scale = own.mean(0), own.std(0)
        scale = np.where(scale > 1e-3 * scale.max(), scale, 1)  # bins that nothing ever moves
    inputs = torch.from_numpy((x - mean) / scale if plan.kind == "published" else x)
    torch.manual_seed(plan.seed)
    network = _network(torch, plan, x.shape[1], start)
    optimiser = torch.optim.NAdam(network.parameters(), lr=RATE)
    first = () if start is None else start.layers
    data = (x, one.place, one.force, *(w for w, _ in first))
    identity = {**asdict(plan), "presses": len(one), "data": [float(np.abs(a).sum(dtype=float)) for a in data]}
    state = _resumed(torch, Path(state_file), identity, network, optimiser)
    loss, judged = {"published": (_rms, _armse), "scaled": (_shares, _shares)}[plan.kind]
    clock = time.monotonic()
    while state["epoch"] < plan.epochs and state["epoch"] - state["best_epoch"] < plan.patience:
        epoch = state["epoch"] + 1
        torch.manual_seed(plan.seed * 1_000_003 + epoch)
        network.train()
        order = parts[0][torch.randperm(len(parts[0]))]
        for first in range(0, len(order), BATCH):
            rows = order[first : first + BATCH]
            optimiser.zero_grad()
            loss(torch, network, _noisy(torch, inputs[rows], plan), y[rows]).backward()
            optimiser.step()
        network.eval()
        with torch.no_grad():
            held = float(judged(torch, network, inputs[parts[1]], y[parts[1]]))
        if not np.isfinite(held):
            raise BadFeatures(f"the loss is {held} after epoch {epoch}: the features hold values beyond any motion")
        state["epoch"] = epoch
        if held < state["best"]:
            state |= {"best": held, "best_epoch": epoch, "weights": _copied(network)}
        if say:
            say(f"epochs of the {plan.kind} network", epoch, plan.epochs)
        if time.monotonic() - clock > SAVED_EVERY:
            _save(torch, Path(state_file), identity, state, network, optimiser)
            clock = time.monotonic()
    network.load_state_dict(state["weights"])
    layers = tuple(
        (m.weight.detach().numpy().copy(), m.bias.detach().numpy().copy())
        for m in network
        if isinstance(m, torch.nn.Linear)
    )
    record = {**asdict(plan), "best_epoch": state["best_epoch"], "validation_loss": state["best"]}
    record |= {"presses": len(parts[0]), "trained_on": dict(one.source)}
    if start is not None:
        record["started_from"] = dict(start.record)
    Path(state_file).unlink(missing_ok=True)
    return ForceModel(plan.kind, layers, mean, scale, plan.bins, one.bins, one.face, one.flow, record)


def _network(torch: Any, plan: Plan, inputs: int, start: ForceModel | None) -> Any:
    nn, modules = torch.nn, []
    scaled = plan.kind == "scaled"
    width = inputs + scaled
    for size in [plan.width or WIDTH[plan.kind]] * LAYERS[plan.kind]:
        modules += [nn.Linear(width, size), *([nn.ReLU()] if scaled else [nn.Sigmoid(), nn.Dropout(DROPOUT)])]
        width = size
    modules.append(nn.Linear(width, plan.bins**2 + scaled))
    network = nn.Sequential(*modules)
    linear = [m for m in network if isinstance(m, nn.Linear)]
    with torch.no_grad():
        for k, m in enumerate(linear):
            nn.init.xavier_uniform_(m.weight, LOGISTIC if plan.kind == "published" and m is not linear[-1] else 1.0)
            nn.init.zeros_(m.bias)
            if start is not None:
                m.weight.copy_(torch.from_numpy(start.layers[k][0]))
                m.bias.copy_(torch.from_numpy(start.layers[k][1]))
    return network


def _noisy(torch: Any, x: Any, plan: Plan) -> Any:
    return x + plan.noise * torch.randn_like(x) if plan.kind == "scaled" and plan.noise else x


def _rms(torch: Any, network: Any, x: Any, y: Any) -> Any:
    """Root mean square error of the presses of a batch, over all bins; 1e-12 N^2 keeps its derivative finite."""
    return torch.sqrt(((network(x) - y) ** 2).mean() + 1e-12)


def _armse(torch: Any, network: Any, x: Any, y: Any) -> Any:
    """(13)"""
    return torch.sqrt(((network(x) - y) ** 2).mean(0)).mean()


def _shares(torch: Any, network: Any, x: Any, y: Any) -> Any:
    """Cross entropy of the shares of the force, and the squared error of the force in units of RESOLUTION."""
    size = torch.sqrt((x * x).sum(1, keepdim=True) / (x.shape[1] // 2)) + 1e-6
    out = network(torch.cat([x / size, torch.log(size)], 1))
    force = size[:, 0] * torch.nn.functional.softplus(out[:, 0])
    total = y.sum(1)
    shares = y / torch.clamp(total, min=1e-9)[:, None]
    return torch.nn.functional.cross_entropy(out[:, 1:], shares) + (((force - total) / RESOLUTION) ** 2).mean()


# -- the state of a training ------------------------------------------------------------------------------------------
def _copied(network: Any) -> dict:
    return {name: value.clone() for name, value in network.state_dict().items()}


def _save(torch: Any, file: Path, identity: dict, state: dict, network: Any, optimiser: Any) -> None:
    with replacing(file) as temporary:
        parts = {"network": network.state_dict(), "optimiser": optimiser.state_dict()}
        torch.save({"identity": identity, "state": state, **parts}, temporary)


def _resumed(torch: Any, file: Path, identity: dict, network: Any, optimiser: Any) -> dict:
    """What is known of a training so far; the network and the optimiser take up what a state file holds."""
    if not file.exists():
        return {"epoch": 0, "best": float("inf"), "best_epoch": 0, "weights": _copied(network)}
    try:
        saved = torch.load(file, weights_only=True)  # numbers alone: nothing in it is run
        if saved["identity"] == identity:
            network.load_state_dict(saved["network"])
            optimiser.load_state_dict(saved["optimiser"])
            return saved["state"]
    except Exception as error:  # a damaged archive fails in many ways
        raise BadFeatures(
            f"{file}: not the state of a training ({type(error).__name__}); remove it to begin anew"
        ) from error
    raise BadFeatures(
        f"{file} is the state of another training, which was stopped; finish that one, or remove the file to begin anew"
    )
