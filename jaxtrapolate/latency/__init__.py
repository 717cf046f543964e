"""Lag and pacing of rendered and generated frames: a simulator, the papers' formulas, and their picture (`plot`)."""

from jaxtrapolate.latency.timeline import Summary as Summary
from jaxtrapolate.latency.timeline import Timeline as Timeline
from jaxtrapolate.latency.timeline import additional_lag as additional_lag
from jaxtrapolate.latency.timeline import presentation_latency as presentation_latency
from jaxtrapolate.latency.timeline import simulate as simulate
from jaxtrapolate.latency.timeline import summarize as summarize
