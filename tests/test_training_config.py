"""Configurations of training runs, from tables, files and the command line."""

import pytest
from toy_task import ToyOptions

from jaxtrapolate.commands.main import main
from jaxtrapolate.errors import InputError
from jaxtrapolate.training import Optimizer, config_names, load_config, parse_config
from jaxtrapolate.weights import load_orbax

GOOD = {"task": "toy", "steps": 10, "optimizer": {"peak_learning_rate": 1, "warmup": 3}, "options": {"crop": [4, 5]}}


def test_configuration_from_a_table():
    made = parse_config(GOOD)
    assert made.options == ToyOptions(crop=(4, 5))
    assert made.optimizer == Optimizer(peak_learning_rate=1.0, warmup=3)
    assert type(made.optimizer.peak_learning_rate) is float
    assert made.pool % made.batch == 0


def test_a_byte_order_mark(tmp_path):
    path = tmp_path / "run.toml"
    path.write_bytes(b'\xef\xbb\xbftask = "toy"\nsteps = 3\n[options]\ncrop = [4, 5]\n')
    assert load_config(path).steps == 3


@pytest.mark.parametrize(
    "change, message",
    [
        ({"task": None}, "task: missing; it has no default"),
        ({"task": 3}, "task: expected a text, got 3"),
        ({"task": "extra"}, "task: no task 'extra'; there are .*'toy'"),
        ({"steps": None}, "steps: missing; it has no default"),
        ({"steps": 1.5}, "steps: expected an integer, got 1.5"),
        ({"steps": True}, "steps: expected an integer, got True"),
        ({"steps": 0}, "steps: expected at least 1, got 0"),
        ({"sted": 1}, "sted: no such setting; there are task, options, steps, .*"),
        ({"precision": "float16"}, "precision: expected one of 'float32', 'bfloat16', got 'float16'"),
        ({"batch": 3}, "pool: expected a multiple of batch = 3, got 64"),
        ({"log_every": 7}, "checkpoint_every: expected a multiple of log_every = 7, got 500"),
        ({"ema_decay": 1.0}, "ema_decay: expected at least 0 and below 1, got 1.0"),
        ({"optimizer": 5}, "optimizer: expected a table, got 5"),
        ({"optimizer": {"lr": 1}}, "optimizer.lr: no such setting; there are peak_learning_rate, .*"),
        ({"optimizer": {"peak_learning_rate": "1"}}, "optimizer.peak_learning_rate: expected a number, got '1'"),
        (
            {"optimizer": {"peak_learning_rate": float("nan")}},
            "optimizer.peak_learning_rate: expected above 0, got nan",
        ),
        ({"optimizer": {"floor": 2}}, "optimizer.floor: expected at least 0 and at most 1, got 2.0"),
        ({"options": []}, r"options: expected a table, got \[\]"),
        ({"options": {"crop": [1]}}, r"options.crop: expected an array of 2, got \[1\]"),
        ({"options": {"crop": [1, "a"]}}, r"options.crop\[1\]: expected an integer, got 'a'"),
        ({"options": {"norm": 1}}, "options.norm: expected true or false, got 1"),
    ],
)
def test_configurations_that_cannot_be(change, message):
    table = {k: v for k, v in {**GOOD, **change}.items() if v is not None}
    with pytest.raises(ValueError, match=f"^{message}$"):
        parse_config(table)


def toml(path, text='task = "toy"\nsteps = 4\nlog_every = 2\ncheckpoint_every = 2\nvalidate_every = 4\n'):
    path.write_text(text)
    return str(path)


def fails(capsys, *arguments):
    """The one line on stderr of a command that ends with status 2."""
    code = main([str(a) for a in arguments])
    err = capsys.readouterr().err
    assert code == 2
    assert err.startswith("jaxtrapolate: ")
    assert err.count("\n") == 1
    return err


@pytest.mark.slow
def test_command(capsys, tmp_path):
    file = toml(tmp_path / "run.toml")
    assert main(["train", file, "--workdir", str(tmp_path / "run")]) == 0
    assert "4 steps of toy: negative -" in " ".join(capsys.readouterr().err.split())
    assert load_orbax(tmp_path / "run" / "model").tree
    (tmp_path / "run.toml").write_text((tmp_path / "run.toml").read_text() + "seed = 1\n")
    assert "seed was 0, is now 1" in fails(capsys, "train", file, "--workdir", tmp_path / "run")


@pytest.mark.slow
def test_command_whose_run_breaks_off(capsys, tmp_path):
    text = 'task = "toy"\nsteps = 100\npool = 8\n[options]\npoison = 0\n'
    assert main(["train", toml(tmp_path / "run.toml", text), "--workdir", str(tmp_path / "run")]) == 1
    err = capsys.readouterr().err
    assert err.startswith("jaxtrapolate: step 1: the loss is nan; its batch is saved in ")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    "text, message",
    [
        ("steps = ", "Invalid value"),
        ('task = "toy"\nsteps = 1\nsped = 1\n', "sped: no such setting"),
        ('task = "toy"\nsteps = 1\n[optimizer]\nclip = "x"\n', "optimizer.clip: expected a number, got 'x'"),
    ],
)
def test_command_with_a_bad_file(capsys, tmp_path, text, message):
    err = fails(capsys, "train", toml(tmp_path / "run.toml", text), "--workdir", tmp_path / "run")
    assert message in err
    assert "run.toml" in err
    assert not (tmp_path / "run").exists()


def test_command_with_changed_settings(capsys, tmp_path, monkeypatch):
    workdir = ("--workdir", str(tmp_path / "run"))
    file = toml(tmp_path / "run.toml")
    changes = ["steps=2", "optimizer.clip = 0.5", "options.crop=[4, 4]", f"start={tmp_path}/none-12345678.npz"]
    given = [word for change in changes for word in ("--set", change)]
    assert "none-12345678.npz: does not exist" in fails(capsys, "train", file, *workdir, *given)
    asked = []
    with monkeypatch.context() as patch:
        patch.setattr("jaxtrapolate.training.train_and_evaluate", lambda config, *_, **__: asked.append(config) or {})
        assert main(["train", str(file), *workdir, *given]) == 0
    capsys.readouterr()
    (config,) = asked
    assert (config.steps, config.optimizer.clip, config.options.crop) == (2, 0.5, (4, 4))
    assert config.start == f"{tmp_path}/none-12345678.npz"
    for change, message in [
        ("sped=1", "sped: no such setting"),
        ("options.crops=1", "options.crops: no such setting"),
        ("steps.x=1", "steps.x: steps is no table"),
        ("steps=many", "steps: expected an integer, got 'many'"),
        ("steps", "--set: expected KEY=VALUE, got 'steps'"),
        ("options.crop=[1", "--set: options.crop: "),
    ]:
        assert message in fails(capsys, "train", file, *workdir, "--set", change)


def test_command_with_bad_arguments(capsys, tmp_path):
    workdir = ("--workdir", tmp_path / "run")
    assert "no-such: no such configuration or TOML file" in fails(capsys, "train", "no-such", *workdir)
    assert "no.toml: does not exist" in fails(capsys, "train", tmp_path / "no.toml", *workdir)
    assert "is a folder" in fails(capsys, "train", tmp_path, *workdir)
    assert "belong together" in fails(capsys, "train", "x", *workdir, "--coordinator", "localhost:1")
    file = toml(tmp_path / "run.toml")
    (tmp_path / "file").write_text("")
    assert "file" in fails(capsys, "train", file, "--workdir", tmp_path / "file")


def test_shipped_configurations():
    """Each can be read, and is refused with a setting that its task does not have."""
    assert len(config_names()) >= 5
    for name in config_names():
        assert load_config(name, {"steps": 7}).steps == 7
        with pytest.raises(InputError, match=r"options\.colour: no such setting"):
            load_config(name, {"options.colour": 1})
