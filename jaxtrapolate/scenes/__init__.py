"""Embedded scenes: an exact analytic renderer in JAX, with every buffer and exact flow, and scenes without end."""

from jaxtrapolate.scenes.render import flow as flow
from jaxtrapolate.scenes.render import keyframe as keyframe
from jaxtrapolate.scenes.render import render as render
from jaxtrapolate.scenes.render import visible as visible
from jaxtrapolate.scenes.scene import Scene as Scene
from jaxtrapolate.scenes.scene import stack_scenes as stack_scenes
from jaxtrapolate.scenes.sequence import SceneSequence as SceneSequence
from jaxtrapolate.scenes.statistics import Statistics as Statistics
from jaxtrapolate.scenes.statistics import statistics as statistics
from jaxtrapolate.scenes.worlds import DEVELOPMENT_SEEDS as DEVELOPMENT_SEEDS
from jaxtrapolate.scenes.worlds import TEST_SEEDS as TEST_SEEDS
from jaxtrapolate.scenes.worlds import TRAINING_SEEDS as TRAINING_SEEDS
from jaxtrapolate.scenes.worlds import scene as scene
from jaxtrapolate.scenes.worlds import scene_names as scene_names
