"""Table 1 of the GAPONet / SimLifter paper, to stand beside what we measure; its robots are real."""

# kg → mean |offset| along X, Y, Z, cm, of GAPONet, an MLP and the simulator's output sent as it is.
TABLE_1 = {
    0.0: ((0.3564, 0.6274, 0.4797), (0.4298, 0.6097, 1.7068), (0.6733, 0.6450, 1.9698)),
    1.0: ((0.3506, 0.7331, 0.4885), (0.4581, 0.5801, 1.7142), (0.5424, 0.7554, 1.9978)),
    2.0: ((0.3725, 0.7357, 0.5759), (0.4363, 0.7374, 1.8323), (0.8149, 1.2051, 2.1376)),
    3.0: ((0.4597, 0.7855, 0.6214), (0.4726, 0.7113, 2.1137), (1.1455, 1.2520, 1.9269)),
}
TABLE_1_METHODS = ("gaponet", "mlp", "raw")
