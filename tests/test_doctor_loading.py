"""The doctor opens files of any origin, and runs nothing that is in them."""

from __future__ import annotations

import base64
import io
import json
import os
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from neuralq.doctor import CannotLoad, load_subject
from neuralq.doctor.weights import EXPORT, read_arrays, read_members, read_state


class Attack:
    """Unpickled, it makes a folder."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return (os.mkdir, (str(self.mark),))


class OwnNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Linear(4, 8)
        self.head = nn.Linear(8, 2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.head(torch.relu(self.body(x)))  # type: ignore[no-any-return]


def saved(value: Any) -> bytes:
    out = io.BytesIO()
    torch.save(value, out)
    return out.getvalue()


def mlp(*sizes: int, rows: int = 2, act: type[nn.Module] = nn.ReLU) -> nn.Sequential:
    layers: list[nn.Module] = []
    for below, above in pairwise(sizes):
        layers += [nn.Linear(below, above), act()]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], rows))


def prefixed(net: nn.Module, prefix: str) -> dict[str, torch.Tensor]:
    return {f"{prefix}{key}": value for key, value in net.state_dict().items()}


def rewritten(raw: bytes, change: Callable[[str, bytes], bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(raw)) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            new.writestr(name, change(name, old.read(name)))
    return out.getvalue()


def sb3_data(**changes: Any) -> dict[str, Any]:
    """As Stable-Baselines3 2.9 writes it; what is serialised would run code."""
    program = base64.b64encode(b"cos\nsystem\n(S'touch /nonexistent/attack'\ntR.").decode()
    return {
        "policy_class": {":type:": "<class 'abc.ABCMeta'>", ":serialized:": program},
        "policy_kwargs": {"net_arch": [8]},
        "observation_space": {":type:": "Box", ":serialized:": program, "dtype": "float32", "_shape": [4]},
        "action_space": {":type:": "Discrete", ":serialized:": program, "n": "2", "start": "0"},
        "train_freq": {":type:": "TrainFreq", ":serialized:": program},
        "lr_schedule": {":type:": "FloatSchedule", ":serialized:": program},
        "gamma": 0.97, "tau": 1.0, "n_steps": 1, "batch_size": 32, "buffer_size": 1000, "learning_starts": 100,
        "target_update_interval": 1000, "num_timesteps": 10_100, "_n_updates": 2500, "learning_rate": 1e-4,
        "exploration_initial_eps": 1.0, "exploration_final_eps": 0.05, **changes,
    }  # fmt: skip


def sb3_zip(
    path: Path, net: nn.Module, head: str = "q_net", optimiser: bytes | None = None, policy: bytes | None = None,
    extra: dict[str, bytes] | None = None, **changes: Any,
) -> Path:  # fmt: skip
    state = OrderedDict({**prefixed(net, f"{head}.{head}."), **prefixed(net, f"{head}_target.{head}.")})
    groups = {"state": {}, "param_groups": [{"lr": 0.002, "params": [0]}]}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", json.dumps(sb3_data(**changes)))
        archive.writestr("policy.pth", policy if policy is not None else saved(state))
        archive.writestr("policy.optimizer.pth", optimiser if optimiser is not None else saved(groups))
        archive.writestr("_stable_baselines3_version", "2.9.2")
        for name, content in (extra or {}).items():
            archive.writestr(name, content)
    return path


OBS = np.random.default_rng(0).standard_normal((5, 4)).astype(np.float32)


def same(subject: Any, net: Callable[[torch.Tensor], torch.Tensor], obs: Any = OBS) -> bool:
    with torch.no_grad():
        return bool(np.allclose(subject.values(obs), net(torch.as_tensor(obs, dtype=torch.float32)).numpy(), atol=1e-6))


# What is in a file comes out as it was.


def test_a_zip_of_stable_baselines_gives_its_values_and_settings(tmp_path: Path) -> None:
    net = mlp(4, 8, act=nn.Tanh)
    kwargs = {"net_arch": [8], "activation_fn": {":type:": "t", ":serialized:": "x"}}
    subject = load_subject(sb3_zip(tmp_path / "a.zip", net, policy_kwargs=kwargs_with_tanh(kwargs)))
    assert same(subject, net) and "2.9.2" in subject.origin and subject.num_actions == 2
    known = subject.settings
    assert (known.gamma, known.learning_rate, known.capacity) == (0.97, 0.002, 1000)  # the rate is the optimiser's
    assert known.steps_of_reach == 10 and subject.target is not None  # copied every 1,000 of 10,000 steps


def kwargs_with_tanh(kwargs: dict[str, Any]) -> dict[str, Any]:
    """Stable-Baselines3 writes the whole of policy_kwargs as a program where it holds a class, with this beside it."""
    return {
        **kwargs,
        ":type:": "dict",
        ":serialized:": "x",
        "activation_fn": "<class 'torch.nn.modules.activation.Tanh'>",
    }


def test_quantiles_are_laid_out_before_actions(tmp_path: Path) -> None:
    net = mlp(4, 8, rows=6)  # 3 quantiles of 2 actions, as sb3-contrib's QuantileNetwork: view(-1, n_quantiles, n)
    subject = load_subject(sb3_zip(tmp_path / "a.zip", net, head="quantile_net"))
    assert same(subject, lambda x: net(x).view(-1, 3, 2).mean(dim=1)) and "QR-DQN" in subject.origin


def test_pictures_of_stable_baselines_come_with_channels_first_and_divided(tmp_path: Path) -> None:
    cnn = nn.Sequential(
        nn.Conv2d(2, 4, 8, 4), nn.ReLU(), nn.Conv2d(4, 4, 4, 2), nn.ReLU(), nn.Conv2d(4, 4, 3, 1), nn.ReLU()
    )
    linear, head = nn.Sequential(nn.Linear(4, 5)), nn.Sequential(nn.Linear(5, 2))
    parts = {"q_net.0": head[0], **{f"features_extractor.cnn.{i}": cnn[i] for i in (0, 2, 4)}}
    parts["features_extractor.linear.0"] = linear[0]
    state = {
        f"{net}.{name}.{key}": value
        for net in ("q_net", "q_net_target")
        for name, layer in parts.items()
        for key, value in layer.state_dict().items()
    }  # fmt: skip
    space = {":type:": "Box", "dtype": "uint8", "_shape": [2, 36, 36]}
    path = sb3_zip(tmp_path / "a.zip", head, policy=saved(state), observation_space=space)
    frames = np.random.default_rng(1).integers(0, 256, (3, 36, 36, 2), dtype=np.uint8)

    def whole(x: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = head(torch.relu(linear(cnn(x.movedim(3, 1) / 255.0).flatten(1))))
        return out

    assert same(load_subject(path), whole, frames)


def test_models_of_cleanrl_with_and_without_atoms(tmp_path: Path) -> None:
    net = mlp(4, 8)
    (tmp_path / "dqn.cleanrl_model").write_bytes(saved(OrderedDict(prefixed(net, "network."))))
    assert same(load_subject(tmp_path / "dqn.cleanrl_model"), net)
    wide, atoms = mlp(4, 8, rows=6), torch.linspace(-1, 1, 3)
    args = {"gamma": 0.98, "target_network_frequency": 500, "train_frequency": 10, "total_timesteps": 20_000}
    c51 = {"model_weights": OrderedDict({**prefixed(wide, "network."), "atoms": atoms}), "args": args}
    (tmp_path / "c51.cleanrl_model").write_bytes(saved(c51))
    subject = load_subject(tmp_path / "c51.cleanrl_model")
    assert same(subject, lambda x: (torch.softmax(wide(x).view(-1, 2, 3), 2) * atoms).sum(2))
    assert subject.settings.gamma == 0.98 and subject.settings.steps_of_reach == 40


def test_state_dicts_of_a_named_class_and_plain_stacks_in_three_formats(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    own, plain = OwnNet(), mlp(4, 8)
    torch.save(own.state_dict(), tmp_path / "own.pth")
    assert same(load_subject(tmp_path / "own.pth", net=f"{__name__}:OwnNet"), own)
    torch.save(plain.state_dict(), tmp_path / "plain.pth")
    save_file(plain.state_dict(), tmp_path / "plain.safetensors")
    np.savez(tmp_path / "plain.npz", **{key: value.numpy() for key, value in plain.state_dict().items()})
    assert all(same(load_subject(tmp_path / f"plain.{kind}"), plain) for kind in ("pth", "safetensors", "npz"))
    assert same(load_subject(own), own) and same(load_subject(lambda s: own(torch.as_tensor(s))), own)


@pytest.mark.slow
def test_a_run_of_neuralq_gives_what_its_agent_says(tmp_path: Path) -> None:
    import neuralq

    run = neuralq.train(
        "CartPole-v1", tmp_path / "run", learner="replay", total_steps=200, learning_starts=50, hidden=(8,),
        evaluation_episodes=1, target_period_updates=30, resume_probe=False, preset=False,
    )  # fmt: skip
    subject, agent = load_subject(run.run_dir), neuralq.load(run.run_dir)
    assert np.allclose(subject.values(OBS)[2], agent.values(OBS[2]), atol=1e-6)
    assert subject.settings.target_period_updates == 30 and subject.settings.steps_of_reach == 5  # 150 updates


def test_stable_baselines_own_zip_gives_what_it_predicts(tmp_path: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.DQN(
        "MlpPolicy", "CartPole-v1", learning_starts=10, policy_kwargs={"net_arch": [8], "activation_fn": nn.Tanh}
    )
    model.learn(100)
    model.save(tmp_path / "a.zip")
    assert same(load_subject(tmp_path / "a.zip"), model.q_net)


# Nothing in a file is run.


def pickled(attack: Attack) -> bytes:
    return saved({"weight": attack})


SLOTS: dict[str, Callable[[Path, bytes], Path]] = {
    "policy.pth": lambda p, raw: sb3_zip(p / "a.zip", mlp(4, 8), policy=raw),
    "policy.optimizer.pth": lambda p, raw: sb3_zip(p / "a.zip", mlp(4, 8), optimiser=raw),
    "cleanrl": lambda p, raw: written(p / "a.cleanrl_model", raw),
    "pth": lambda p, raw: written(p / "a.pth", raw),
    "safetensors": lambda p, raw: written(p / "a.safetensors", raw),
    "npz": lambda p, raw: written(p / "a.npz", raw),
}


def written(path: Path, raw: bytes) -> Path:
    path.write_bytes(raw)
    return path


@pytest.mark.parametrize("slot", SLOTS)
def test_a_pickle_that_attacks_is_refused_in_every_slot_of_every_format(slot: str, tmp_path: Path) -> None:
    mark = tmp_path / "attacked"
    path = SLOTS[slot](tmp_path, pickled(Attack(mark)))
    with pytest.raises(CannotLoad):
        load_subject(path)
    assert not mark.exists()


def test_slots_that_are_not_needed_are_not_read_and_serialised_fields_never_decoded(tmp_path: Path) -> None:
    mark = tmp_path / "attacked"
    raw = pickled(Attack(mark))
    path = sb3_zip(tmp_path / "a.zip", mlp(4, 8), extra={"pytorch_variables.pth": raw, "replay_buffer.pkl": raw})
    before = set(sys.modules)
    assert load_subject(path).values(OBS).shape == (5, 2)
    assert not mark.exists() and not {"cloudpickle", "stable_baselines3"} & (set(sys.modules) - before)


def test_objects_in_arrays_are_refused(tmp_path: Path) -> None:
    mark = tmp_path / "attacked"
    np.savez(tmp_path / "a.npz", obs=np.array([Attack(mark)], dtype=object))
    with pytest.raises(CannotLoad, match=r"numpy\.savez"):
        read_arrays((tmp_path / "a.npz").read_bytes(), "a.npz")
    assert not mark.exists()


def test_a_whole_model_is_refused_with_the_two_lines_that_export_it(tmp_path: Path, monkeypatch: Any) -> None:
    torch.save(OwnNet(), tmp_path / "model.pth")
    with pytest.raises(CannotLoad, match=r"OwnNet.*run code.*import torch; torch\.save\(model\.state_dict\(\)"):
        load_subject(tmp_path / "model.pth", net=f"{__name__}:OwnNet")
    monkeypatch.chdir(tmp_path)
    model = OwnNet()
    exec(EXPORT, {"model": model})
    assert same(load_subject("weights.pth", net=f"{__name__}:OwnNet"), model)


def test_instructions_that_no_state_dict_needs_are_refused() -> None:
    raw = saved({"weight": torch.zeros(2)})

    def program(name: str, content: bytes) -> bytes:
        return b"\x80\x04\x8c\x02os\x8c\x06system\x93." if name.endswith("data.pkl") else content

    with pytest.raises(CannotLoad, match="STACK_GLOBAL"):
        read_state(rewritten(raw, program), "x.pth")


# Archives and tensors are bounded before anything is unpacked.


def archive(*members: tuple[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in members:
            made.writestr(name, content)
    return out.getvalue()


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (archive(("data", bytes(5_000_000))), "200 times its size"),
        (archive(("../x", b"1")), "leads out"),
        (archive(("/etc/x", b"1")), "leads out"),
        (archive(("a/../../x", b"1")), "leads out"),
        (archive(("c:x", b"1")), "leads out"),
        (archive(("data", b"abc"))[:-30], "no whole zip archive"),
        (b"", "no whole zip archive"),
        (archive(*((f"m{i}", b"") for i in range(10_001))), "members"),
    ],
    ids=["bomb", "above", "absolute", "above later", "drive", "cut", "empty", "too many"],  # an archive tells the time
)
def test_archives_that_no_library_writes_are_refused(raw: bytes, message: str) -> None:
    with pytest.raises(CannotLoad, match=message):
        read_members(raw, lambda name: True, "a.zip")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_members_of_one_name_are_refused() -> None:
    with pytest.raises(CannotLoad, match="two members of one name"):
        read_members(archive(("data", b"1"), ("data", b"2")), lambda name: True, "a.zip")


@pytest.mark.parametrize("shape", [(2**40,), (2**20, 2**20)])
def test_a_tensor_of_two_to_the_forty_entries_is_refused_before_it_is_allocated(shape: tuple[int, ...]) -> None:
    with pytest.raises(CannotLoad, match="entries"):
        read_state(saved({"weight": torch.zeros(1).expand(shape)}), "x.pth")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": shape})  # type: ignore[no-untyped-call]
    with pytest.raises(CannotLoad, match="does not fit"):
        read_arrays(archive(("obs.npy", header.getvalue() + bytes(64))), "a.npz")


@pytest.mark.parametrize("keep", [10, 300, 900])
def test_truncated_files_say_so(keep: int, tmp_path: Path) -> None:
    for name, raw in (("a.pth", saved(mlp(4, 8).state_dict())), ("a.cleanrl_model", saved(mlp(4, 8).state_dict()))):
        with pytest.raises(CannotLoad, match=name):
            load_subject(written(tmp_path / name, raw[:keep]))
    whole = sb3_zip(tmp_path / "b.zip", mlp(4, 8)).read_bytes()
    with pytest.raises(CannotLoad, match=r"c\.zip"):
        load_subject(written(tmp_path / "c.zip", whole[:keep]))


def test_records_that_hold_less_than_their_tensor_says_are_refused() -> None:
    raw = rewritten(saved({"weight": torch.zeros(8)}), lambda name, c: c[:8] if name.endswith("data/0") else c)
    with pytest.raises(CannotLoad, match="record size"):
        read_state(raw, "x.pth")


# What does not fit is named.


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"body.weight": torch.zeros(8, 4), "body.bias": torch.zeros(8)}, "lacks the key 'head.weight'"),
        ({**OwnNet().state_dict(), "extra": torch.zeros(1)}, "has the key 'extra'"),
        ({**OwnNet().state_dict(), "head.bias": torch.zeros(3)}, r"'head.bias' has the shape \[3\].*\[2\]"),
        ({**OwnNet().state_dict(), "step": 3}, "'step' is no tensor"),
    ],
)
def test_keys_and_shapes_that_do_not_fit_are_named(state: dict[str, Any], message: str, tmp_path: Path) -> None:
    torch.save(state, tmp_path / "a.pth")
    with pytest.raises(CannotLoad, match=message):
        load_subject(tmp_path / "a.pth", net=f"{__name__}:OwnNet")


def test_weights_of_an_unknown_network_ask_for_its_class(tmp_path: Path) -> None:
    torch.save(OwnNet().state_dict(), tmp_path / "a.pth")
    with pytest.raises(CannotLoad, match="--net your_module:YourNetwork"):
        load_subject(tmp_path / "a.pth")
    torch.save({"0.weight": torch.zeros(8, 4), "2.weight": torch.zeros(2, 9)}, tmp_path / "b.pth")
    with pytest.raises(CannotLoad, match=r"2.weight takes 9 numbers, and the layer before gives 8"):
        load_subject(tmp_path / "b.pth")


@pytest.mark.parametrize(
    ("net", "message"), [("os", "module:Class"), ("nowhere:Net", "ModuleNotFoundError"), ("builtins:dict", "made dict")]
)
def test_networks_that_cannot_be_made_are_refused(net: str, message: str, tmp_path: Path) -> None:
    torch.save(OwnNet().state_dict(), tmp_path / "a.pth")
    with pytest.raises(CannotLoad, match=message):
        load_subject(tmp_path / "a.pth", net=net)


def test_policies_without_action_values_and_unknown_files_are_refused(tmp_path: Path) -> None:
    state = saved({"mlp_extractor.policy_net.0.weight": torch.zeros(2, 2)})
    with pytest.raises(CannotLoad, match="holds no action values"):
        load_subject(sb3_zip(tmp_path / "ppo.zip", mlp(4, 8), policy=state))
    with pytest.raises(CannotLoad, match="must be a whole number"):
        load_subject(sb3_zip(tmp_path / "sac.zip", mlp(4, 8), action_space={":type:": "Box"}))
    with pytest.raises(CannotLoad, match="is none of"):
        load_subject(written(tmp_path / "notes.txt", b"x"))
    with pytest.raises(CannotLoad, match="there is no"):
        load_subject(tmp_path / "nothing.zip")


@pytest.mark.slow
def test_a_run_is_examined_in_the_wrappers_it_was_trained_in(tmp_path: Path) -> None:
    import neuralq
    from neuralq.doctor import examine

    run = neuralq.train(
        "CartPole-v1", tmp_path / "run", total_steps=200, evaluation_episodes=1, resume_probe=False, preset=False,
        num_envs=2, num_steps=16, hidden=(8,), frame_stack=2,
    )  # fmt: skip
    report = examine(run.run_dir, budget_s=2)
    assert "V1" in {one.id for one in report.measured} and report.env == "CartPole-v1"
