import sys, tempfile, signal, time, subprocess, json, os
from pathlib import Path
from test.ros.harness import *
def cpu(pid):
    f=open(f'/proc/{pid}/stat').read().rsplit(')',1)[1].split(); return (int(f[11])+int(f[12]))/os.sysconf('SC_CLK_TCK')
for cam,scene in (('sr3000','room'),('sr3000_every_effect','room')):
  for rate in (25,50):
    w=World(Path(tempfile.mkdtemp()))
    d=w.start('driver_node',frame_rate=float(rate),camera=cam,scene=scene); c=w.start('correction_node',camera=cam)
    time.sleep(6)
    w.environment['_']=''
    m=subprocess.Popen([sys.executable,'-m','rim_camera_ros.nodes.latency_monitor','--frames',str(rate*20)],env=w.environment,stdout=subprocess.PIPE)
    time.sleep(5); a=(cpu(d.pid),cpu(c.pid),cpu(m.pid)); t=time.time(); time.sleep(12); b=(cpu(d.pid),cpu(c.pid),cpu(m.pid)); dt=time.time()-t
    out=json.loads(m.communicate()[0]); print(cam,rate,'cpu%',[round(100*(y-x)/dt,1) for x,y in zip(a,b)],out)
    for p in (d,c): p.send(signal.SIGINT); p.wait()
