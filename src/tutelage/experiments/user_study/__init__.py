"""The user study of chapter 3 and appendix B.4: one person, three robots, four ways to ask, and a game between requests.

The protocol, the game and the questions are here, for people at the console as for simulated ones.
"""
