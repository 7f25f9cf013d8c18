"""Learning from recordings that is interrupted and goes on."""

import pytest

from garat_jax.agents.ppo import PPOConfig
from garat_jax.ground import GroundConfig, ground, learn
from garat_jax.methods.garat import GARATConfig
from garat_jax.runs import RunDirectory

SMALL = GroundConfig(
    "garat",
    GARATConfig(transformer=PPOConfig(num_envs=8, num_steps=16, num_epochs=1), num_minibatches=4),
    num_updates=4,
    num_transitions=300,
    num_held_out=50,
)


class Interrupted(RunDirectory):
    """A run that is interrupted after its second update."""

    def log(self, step, **metrics):
        super().log(step, **metrics)
        if step == 2:
            raise KeyboardInterrupt


@pytest.mark.slow
def test_interrupted_and_resumed_garat_learns_what_it_does_uninterrupted(
    read, tmp_path, monkeypatch
):
    def stop(*arguments):
        raise RuntimeError("it has been learned")

    def learned(name, error, cls=RunDirectory, resume=False) -> str:
        run = cls.create(tmp_path / name, {}, "test", [0], resume=resume)
        with pytest.raises(error):
            ground(model, recordings[:2], SMALL, run, holdout=recordings[2:])
        return (run.root / "metrics.jsonl").read_text()

    model, recordings = read
    monkeypatch.setattr(learn, "compare", stop)
    whole = learned("whole", RuntimeError)
    assert len(learned("cut", KeyboardInterrupt, Interrupted).splitlines()) == 2
    assert learned("cut", RuntimeError, resume=True) == whole
