"""dyfn-replay: a recording through the stream session, its scores and outputs."""
