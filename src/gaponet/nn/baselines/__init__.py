"""What the operator has to beat, given the same data and the same simulator."""
