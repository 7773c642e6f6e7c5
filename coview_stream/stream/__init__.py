"""The live side: nodes and clients exchange lidar frames, odometry and poses over zenoh or ROS 2."""
