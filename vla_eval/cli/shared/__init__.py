"""What several verbs share: arguments, cluster, tables, probes, replays."""
