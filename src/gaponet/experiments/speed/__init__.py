"""How fast it is: simulation, training, one correction of a trained model, the aligned simulator."""
