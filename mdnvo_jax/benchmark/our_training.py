"""Our training as it is measured: steps on one batch that stays."""

from typing import Any

from mdnvo_jax.benchmark import material
from mdnvo_jax.benchmark.timing import Contender
from mdnvo_jax.config import Config
from mdnvo_jax.model.network import build
from mdnvo_jax.training import parallel, step
from mdnvo_jax.training.state import State


class OurTraining:
    """Our training: one state, stepped by whichever variant has its turn."""

    def __init__(self, config: Config, devices: int = 1) -> None:
        self.config = config
        self.mesh = parallel.make_mesh(config.training.batch_size, devices)
        self.batch = parallel.place(material.training_batch(config), self.mesh)
        self.state = self.fresh()

    def fresh(self) -> State:
        """Return the state before the first step."""
        return material.fresh_state(self.config, self.mesh)

    def compiled(self, config: Config) -> Any:
        """Return the compiled step of a variant."""
        network = build(config.image, config.model)
        function: Any = parallel.compile_step(step.bind(step.train_step, network, config), self.mesh, donate=True)
        return function.lower(self.state, self.batch).compile()

    def contender(self, function: Any) -> Contender:
        """Return what takes one step with a compiled variant."""

        def run() -> Any:
            self.state, metrics = function(self.state, self.batch)
            return self.state, metrics

        return run
