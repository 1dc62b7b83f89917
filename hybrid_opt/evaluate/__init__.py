"""What a candidate is worth: compiled model, verdict, objectives, certification, static hold."""
