from dataclasses import dataclass
class UnrelatedRoad: pass
