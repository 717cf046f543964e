"""The commands of `jaxtrapolate`, one module each."""
