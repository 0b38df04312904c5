"""DP-SLAM (Eliazar and Parr 2004): a particle filter over trajectories that share one map."""
