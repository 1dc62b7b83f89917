"""From a problem (robots, payload, start, goal, environment) to a workcell with a first carry."""
