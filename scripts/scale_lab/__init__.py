"""One world on real processes: a NATS server, a sequencer, edges, standbys and bots, which are killed and measured."""
