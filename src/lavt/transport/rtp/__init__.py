"""RTP and RTCP: packets, reports, the jitter buffer and forward error correction."""
