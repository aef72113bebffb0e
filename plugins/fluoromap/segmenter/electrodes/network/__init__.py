"""The network that proposes electrodes: its layers, how it is run, its weights, its answers."""
