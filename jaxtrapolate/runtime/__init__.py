"""What runs need of the machine: timing, memory, and folders of output that outlive a killed run."""
