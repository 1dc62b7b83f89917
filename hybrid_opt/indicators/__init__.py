"""Figures of fronts: indicators, statistics, attainment surfaces, selection."""
