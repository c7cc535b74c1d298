"""What robot should be built, and how should it move: studies of designs and gaits over two fidelities."""
