"""The compliance report: how far drives kept a latency limit, judged from their records."""
