import numpy as np
from geomtact.geometry.distance import PoseDistance, mode_radius
def test_m(plug,a_touch):
    post=plug.localize(a_touch(plug)[1],effort="fast")
    d=PoseDistance(post.mesh,128); r=mode_radius(post.mesh); modes=post.modes(5)
    left=np.exp(post.log_prob); P=post.poses
    moved=np.zeros(0,int)
    print('radius',r,'slack',d.slack)
    for (row,mass),m in zip(post._grown(5),modes):
        near=np.flatnonzero(d.mean(m.T,P)<=r); got=post._within(post._sensor_poses(np.array([row]))[0],d,r,moved)
        print(len(near),len(got),np.setdiff1d(near,got),np.setdiff1d(got,near),mass,left[near].sum()); 
        miss=np.setdiff1d(near,got)
        if len(miss): print(d.turned(m.T[:3,:3],P[miss][:,:3,:3]),d.mean(m.T,P[miss]))
        left[near]=0
    print(len(P))
