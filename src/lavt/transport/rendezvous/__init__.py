"""The rendezvous: forward datagrams between a vehicle and an operator behind NAT."""
