"""What accuracy costs in time: our fits, their peers and the published method, measured."""
