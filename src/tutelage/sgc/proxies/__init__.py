"""Proxies: what speaks ROS 2, rosbridge or gRPC takes part in the fleet's topics, with no change to the application."""
