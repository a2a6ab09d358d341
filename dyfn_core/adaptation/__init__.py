"""A model adapted to one's own recordings, by depth that is triangulated with their odometry."""
