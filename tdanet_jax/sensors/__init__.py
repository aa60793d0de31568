"""What an agent perceives: detections, odometry, triangulation."""
