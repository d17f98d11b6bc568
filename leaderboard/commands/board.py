"""placeholder"""
def leaderboard(): pass
