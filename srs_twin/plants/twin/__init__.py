"""The MuJoCo twin: model, physics, contacts and batches."""
