"""Where keypoints come from when nobody gives them: object phrases, masks of those objects, points on their surface."""
