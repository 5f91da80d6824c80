"""The supervision server: people at a browser help a fleet of robots, and every intervention trains its policy."""
