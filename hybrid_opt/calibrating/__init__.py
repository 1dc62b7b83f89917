"""What recorded runs of a real cell say of its numbers: sensors, payload, friction, forces."""
