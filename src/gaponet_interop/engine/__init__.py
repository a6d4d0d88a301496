"""What other simulators take: the network in torch, the simulator's facts, an MJCF, an action term."""
