"""Matrix products for generated C: column by column, `restrict`, partial sums, so that compilers
vectorise them.

CasADi's own triple loop adds into memory that the compiler must take for aliased. These have the
signatures and the meaning of CasADi's helpers of the same name (z += x y, or x' y with `tr`; sparse
matrices in compressed columns).
"""

from __future__ import annotations

_MTIMES_DENSE = """\
static void casadi_mtimes_dense(const casadi_real* restrict x, casadi_int nrow_x, casadi_int ncol_x,
    const casadi_real* restrict y, casadi_int ncol_y, casadi_real* restrict z, casadi_int tr) {
  casadi_int i, j, k, l;
  for (i=0; i<ncol_y; ++i) {
    const casadi_real* restrict a = x;
    if (tr) {
      for (j=0; j<ncol_x; ++j, a+=nrow_x) {
        casadi_real s[8] = {0}, r = 0;
        for (k=0; k+8<=nrow_x; k+=8) {
          for (l=0; l<8; ++l) s[l] += a[k+l]*y[k+l];
        }
        for (; k<nrow_x; ++k) r += a[k]*y[k];
        z[j] += r + (((s[0]+s[4]) + (s[1]+s[5])) + ((s[2]+s[6]) + (s[3]+s[7])));
      }
      y += nrow_x; z += ncol_x;
    } else {
      for (k=ncol_x; k>=4; k-=4, a+=4*nrow_x, y+=4) {
        const casadi_real* restrict b = a + nrow_x;
        const casadi_real* restrict c = b + nrow_x;
        const casadi_real* restrict d = c + nrow_x;
        const casadi_real ya = y[0], yb = y[1], yc = y[2], yd = y[3];
        for (j=0; j<nrow_x; ++j) z[j] += (a[j]*ya + b[j]*yb) + (c[j]*yc + d[j]*yd);
      }
      for (; k>0; --k, a+=nrow_x, ++y) {
        const casadi_real ya = y[0];
        for (j=0; j<nrow_x; ++j) z[j] += a[j]*ya;
      }
      z += nrow_x;
    }
  }
}
"""

_MTIMES = """\
static void casadi_mtimes(const casadi_real* restrict x, const casadi_int* sp_x, const casadi_real* restrict y,
    const casadi_int* sp_y, casadi_real* restrict z, const casadi_int* sp_z, casadi_real* restrict w, casadi_int tr) {
  const casadi_int *colind_x = sp_x+2, *row_x = sp_x + 2 + sp_x[1]+1;
  const casadi_int *colind_y = sp_y+2, *row_y = sp_y + 2 + sp_y[1]+1;
  const casadi_int *colind_z = sp_z+2, *row_z = sp_z + 2 + sp_z[1]+1;
  casadi_int cc, kk, k1;
  for (cc=0; cc<sp_z[1]; ++cc) {
    if (tr) {
      for (kk=colind_y[cc]; kk<colind_y[cc+1]; ++kk) w[row_y[kk]] = y[kk];
      for (kk=colind_z[cc]; kk<colind_z[cc+1]; ++kk) {
        const casadi_int from = colind_x[row_z[kk]], n = colind_x[row_z[kk]+1] - from;
        const casadi_int* r = row_x + from;
        const casadi_real* restrict c = x + from;
        casadi_real s = 0;
        if (n > 0 && r[n-1] - r[0] == n-1) {  /* a column without gaps needs no row numbers */
          const casadi_real* restrict v = w + r[0];
          casadi_real t[8] = {0};
          casadi_int l;
          for (k1=0; k1+8<=n; k1+=8) {
            for (l=0; l<8; ++l) t[l] += c[k1+l]*v[k1+l];
          }
          for (; k1<n; ++k1) s += c[k1]*v[k1];
          s += ((t[0]+t[4]) + (t[1]+t[5])) + ((t[2]+t[6]) + (t[3]+t[7]));
        } else {
          for (k1=0; k1<n; ++k1) s += c[k1]*w[r[k1]];
        }
        z[kk] += s;
      }
    } else {
      for (kk=colind_z[cc]; kk<colind_z[cc+1]; ++kk) w[row_z[kk]] = z[kk];
      for (kk=colind_y[cc]; kk<colind_y[cc+1]; ++kk) {
        const casadi_int from = colind_x[row_y[kk]], n = colind_x[row_y[kk]+1] - from;
        const casadi_int* r = row_x + from;
        const casadi_real* restrict c = x + from;
        const casadi_real s = y[kk];
        if (n > 0 && r[n-1] - r[0] == n-1) {
          casadi_real* restrict v = w + r[0];
          for (k1=0; k1<n; ++k1) v[k1] += c[k1]*s;
        } else {
          for (k1=0; k1<n; ++k1) w[r[k1]] += c[k1]*s;
        }
      }
      for (kk=colind_z[cc]; kk<colind_z[cc+1]; ++kk) z[kk] = w[row_z[kk]];
    }
  }
}
"""

PRODUCTS = {"casadi_mtimes_dense": _MTIMES_DENSE, "casadi_mtimes": _MTIMES}
"""Definitions by the name of the helper that they replace."""
