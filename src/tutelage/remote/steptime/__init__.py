"""How long a fleet step takes on the network (table 8.3), beside SSH and SFTP on the same machine.

python -m tutelage.remote.steptime --robots 4 --steps 100
"""
