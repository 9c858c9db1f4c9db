"""BenchMARL: the experiment of its front page, with an environment of coopenv as the task."""

# /// script
# dependencies = ["coopenv", "benchmarl>=1.5", "torch"]
# [tool.coopenv]
# package = "benchmarl"
# documentation = "https://benchmarl.readthedocs.io/en/latest/usage/running.html"
# needs = ["examples/trainers/benchmarl_task.py", "examples/trainers/torchrl_env.py"]
# ///

from benchmarl.algorithms import MappoConfig
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from benchmarl_task import task

config = ExperimentConfig.get_from_yaml()
config.loggers, config.render, config.max_n_iters, config.max_n_frames = [], False, 1, None
config.on_policy_n_envs_per_worker, config.on_policy_collected_frames_per_batch = 8, 800
config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = 200, 2
config.evaluation, config.create_json = False, False
experiment = Experiment(
    task=task("take_turns"),
    algorithm_config=MappoConfig.get_from_yaml(),
    model_config=MlpConfig.get_from_yaml(),
    critic_model_config=MlpConfig.get_from_yaml(),
    seed=0,
    config=config,
)
experiment.run()
print(f"MAPPO: {experiment.total_frames} frames")
