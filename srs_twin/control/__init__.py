"""Controllers: what decides the valves, whichever plant they drive."""
