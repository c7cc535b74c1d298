"""Images, videos and interactive simulation of the twin in MuJoCo."""
