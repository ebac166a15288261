"""Controllers at work: the loop that waits for plans, the loop against the clock, trajectories and reports."""
