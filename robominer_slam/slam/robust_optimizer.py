"""prototype"""
from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from robominer_slam.geometry import FloatArray
from robominer_slam.slam.loop_consistency import (
    Innovations, Loops, chain_odometry, clusters, convincing, evidence_threshold, innovations, neighbouring_pairs,
    pair_innovations, space_log_volume,leave_one_out
)
from robominer_slam.slam.pose_graph import OptimizationOptions, PoseGraph, PoseGraphError

ALPHA=0.05
WRONG=0.05
WRONG_FINAL=0.5
WINDOW=20
VERBOSE=False
SAMPLES=100
def say(*a):
    if VERBOSE: print(*a,flush=True)

class Growth:
    def __init__(self, graph, odometry=None):
        ends=graph.edge_nodes
        self.graph=graph
        self.odo=np.abs(ends[:,0]-ends[:,1])==1 if odometry is None else odometry
        self.loop_edges=np.flatnonzero(~self.odo)
        cov=np.linalg.inv(graph.edge_information)
        dim=graph.dim
        self.loops=Loops(dim,ends[self.loop_edges,0],ends[self.loop_edges,1],graph.edge_measurements[self.loop_edges],cov[self.loop_edges])
        self.ends=np.stack([self.loops.i,self.loops.j],-1)
        self.d=3 if dim==2 else 6
        m=max(self.loop_edges.size,1)
        self.gate=float(chi2_distribution.isf(ALPHA/m,self.d))
        self.accepted=np.zeros(self.loop_edges.size,bool)
        self.strikes=np.zeros(self.loop_edges.size,int)
        self.predicted=np.full(self.loop_edges.size,np.nan)
        self.solves=0
    def solve(self):
        g=self.graph
        g.set_edge_enabled(self.loop_edges,False); g.set_edge_enabled(self.loop_edges[self.accepted],True)
        r=g.optimize(OptimizationOptions(max_iterations=100,relative_tolerance=1e-6))
        self.solves+=1
        return r
    def scale(self):
        known=self.predicted[self.accepted]
        if known.size<20: return 1.0
        return min(1.0,float(max(np.quantile(known,.99),np.quantile(self.loo,.99))/chi2_distribution.ppf(.99,self.d)))
    def drop(self):
        removed=0
        while self.accepted.any():
            idx=np.flatnonzero(self.accepted)
            P=self.graph.relative_covariances(self.ends[idx],SAMPLES,self.solves)
            d2=leave_one_out(self.loops[idx],self.graph.poses,P)
            self.loo=d2
            gate=self.gate*self.scale()
            sus=np.flatnonzero(d2>0.5*gate)
            if not sus.size: break
            d2=leave_one_out(self.loops[idx[sus]],self.graph.poses,self.graph.relative_covariances(self.ends[idx[sus]]))
            bad=d2>gate
            if not bad.any(): break
            out=idx[sus[bad&(d2>=0.7*d2.max())]]
            self.accepted[out]=False
            self.strikes[out]+=1
            removed+=out.size
            say('   removed',out.size,'worst',d2.max(),'false' ,(~self.truth[out]).sum())
            self.solve()
        return removed
    def run(self,truth=None):
        self.truth=truth
        t0=perf_counter(); g=self.graph
        m=self.loop_edges.size
        self.solve()
        ends=self.graph.edge_nodes; n=g.node_count
        info=np.zeros((n-1,self.d,self.d)); o=np.flatnonzero(self.odo)
        np.add.at(info,np.minimum(ends[o,0],ends[o,1]),g.edge_information[o])
        odo=chain_odometry(g.dim,g.poses,np.linalg.inv(info))
        self.V=space_log_volume(g.dim,g.poses)
        pairs=neighbouring_pairs(self.loops,WINDOW)
        pt=pair_innovations(self.loops,odo,pairs)
        good=convincing(pt,self.V,self.gate,WRONG)
        gp=pairs[good]
        self.gp=gp
        say('pairs',len(pairs),'good',good.sum(),'t',perf_counter()-t0)
        if truth is not None: 
            ft=~truth; say('   false pairs',(ft[gp[:,0]]&ft[gp[:,1]]).sum(),'mixed',(ft[gp[:,0]]!=ft[gp[:,1]]).sum(), 'true loops in pairs',np.unique(gp)[truth[np.unique(gp)]].size,'of',truth.sum())
        wrong=WRONG
        for rnd in range(200):
            open_=np.flatnonzero(~self.accepted&(self.strikes<(2 if wrong==WRONG else 5)))
            P=g.relative_covariances(self.ends[open_],SAMPLES,self.solves)
            t=innovations(self.loops[open_],g.poses,P)
            s2=self.scale()
            ok=convincing(t.with_covariance_times(s2),self.V,self.gate,wrong)
            how='single'
            new=open_[ok]
            if not new.size:
                passing=np.zeros(m,bool); passing[open_[t.squared<self.gate*s2]]=True
                keep=passing[gp].all(1)
                lab=clusters(gp[keep],m); lab[~passing]=-1
                size=np.bincount(lab[lab>=0],minlength=m)
                how='cluster'
                if size.size and size.max()>=2: new=np.flatnonzero(lab==size.argmax())
                elif wrong==WRONG:
                    wrong=WRONG_FINAL; say('final'); continue
                else: break
            pos=np.searchsorted(open_,new)
            if VERBOSE and truth is not None:
                for k,q in zip(new,pos):
                    if not truth[k] or wrong==WRONG_FINAL: print('    ','true' if truth[k] else 'FALSE',k,self.ends[k],'d2 %.3f B %.2f ev %.2f evs %.2f'%(t.squared[q],t.best_evidence(self.V)[q],t.evidence(self.V)[q],t.with_covariance_times(s2).evidence(self.V)[q]), 'thr',evidence_threshold(t,self.V,self.gate,.5*wrong),evidence_threshold(t.with_covariance_times(s2),self.V,self.gate/s2,.5*wrong),'next',np.sort(t.with_covariance_times(s2).evidence(self.V)[t.squared<self.gate])[-6:])
            self.predicted[new]=t.squared[pos]
            self.accepted[new]=True
            r=self.solve()
            k=self.drop()
            say(rnd,how,'s2 %.3f'%s2,'new',new.size,'false among' ,(~truth[new]).sum() if truth is not None else '','removed',k,'accepted',self.accepted.sum(),'false',(self.accepted&~truth).sum() if truth is not None else '','its',r.iterations,'t %.2f'%(perf_counter()-t0))
        self.rounds=rnd
        return perf_counter()-t0
    def tests(self):
        return innovations(self.loops,self.graph.poses,self.graph.relative_covariances(self.ends,SAMPLES,self.solves))
