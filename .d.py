import sys, time, tempfile, numpy as np
from pathlib import Path
sys.path.insert(0,"tests")
from soak import kills
from soak.forked import warm_up, start
from soak.killed import run_reporting
def prof(out):
    import cProfile,pstats
    p=cProfile.Profile(); p.enable()
    run_reporting(["duration=0.05"],out,out+".page")
    p.disable(); pstats.Stats(p).sort_stats("cumtime").print_stats(25)
if __name__=="__main__":
    warm_up()
    f=Path(tempfile.mkdtemp())
    for k in range(3):
        t=time.monotonic(); p=start(run_reporting,["duration=0.05"],str(f/f"{k}"),str(f/f"{k}p")); a=time.monotonic()-t; p.join(); print(a,time.monotonic()-t)
    from soak.killed import Page
    Page(Path(str(f/"x")+".page"))
    p=start(prof,str(f/"x")); p.join()
