"""The robot's side: send frames, receive poses, replay recordings."""
