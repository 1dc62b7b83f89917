"""What the programs do, apart from their options: imported when they run."""
