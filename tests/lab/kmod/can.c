// SPDX-License-Identifier: GPL-2.0
/*
 * Fault confinement of a CAN controller on demand: QEMU's controllers share a
 * perfect bus and never make errors.
 *
 *   echo "can0 bus-off" > /sys/module/imud_lab/parameters/can_fault
 *
 * does what a controller's driver does in its error interrupt: the interface
 * changes its state, an error frame goes to the sockets that want it, and after
 * bus-off the driver's own restart is due.
 *
 *   echo "can0 128 0" > /sys/module/imud_lab/parameters/can_counters
 *
 * has the driver report these error counters, transmit and receive, in place of
 * the chip's, which stay 0; "can0 0 0" has it report the chip's again.
 */
#include <linux/can/dev.h>
#include <linux/can/error.h>
#include <linux/module.h>
#include <linux/netdevice.h>
#include <linux/rtnetlink.h>
#include <net/net_namespace.h>

static const char *const names[] = {
	[CAN_STATE_ERROR_ACTIVE] = "error-active",
	[CAN_STATE_ERROR_WARNING] = "error-warning",
	[CAN_STATE_ERROR_PASSIVE] = "error-passive",
	[CAN_STATE_BUS_OFF] = "bus-off",
};

static int enter(struct net_device *dev, enum can_state state)
{
	struct can_priv *priv = safe_candev_priv(dev);
	struct can_frame *frame;
	struct sk_buff *skb;

	if (!priv || !netif_running(dev))
		return -ENETDOWN;
	if (priv->state == state)
		return -EALREADY;
	skb = alloc_can_err_skb(dev, &frame);
	if (!skb)
		return -ENOMEM;
	can_change_state(dev, frame, state, state);
	if (state == CAN_STATE_BUS_OFF)
		can_bus_off(dev);
	netif_rx(skb);
	return 0;
}

static int can_fault_set(const char *value, const struct kernel_param *param)
{
	char name[IFNAMSIZ], fault[16];
	struct net_device *dev;
	int result = -EINVAL;

	if (sscanf(value, "%15s %15s", name, fault) != 2)
		return -EINVAL;
	rtnl_lock();
	dev = __dev_get_by_name(&init_net, name);
	for (int state = 0; dev && state < ARRAY_SIZE(names); state++)
		if (!strcmp(fault, names[state]))
			result = enter(dev, state);
	rtnl_unlock();
	return result;
}

static const struct kernel_param_ops can_fault_ops = { .set = can_fault_set };
module_param_cb(can_fault, &can_fault_ops, NULL, 0200);
MODULE_PARM_DESC(can_fault, "INTERFACE STATE: let a CAN controller enter an error state");

/* The one interface whose counters are not the chip's, and its driver's function. */
static struct net_device *counted;
static int (*chip_counters)(const struct net_device *, struct can_berr_counter *);
static struct can_berr_counter counters;

static int given_counters(const struct net_device *dev, struct can_berr_counter *found)
{
	*found = counters;
	return 0;
}

static int count(struct net_device *dev, u16 tx, u16 rx)
{
	struct can_priv *priv = safe_candev_priv(dev);

	if (!priv || !priv->do_get_berr_counter)
		return -EOPNOTSUPP;
	if (counted)
		safe_candev_priv(counted)->do_get_berr_counter = chip_counters;
	counted = NULL;
	counters.txerr = tx;
	counters.rxerr = rx;
	if (tx || rx) {
		counted = dev;
		chip_counters = priv->do_get_berr_counter;
		priv->do_get_berr_counter = given_counters;
	}
	return 0;
}

static int can_counters_set(const char *value, const struct kernel_param *param)
{
	char name[IFNAMSIZ];
	struct net_device *dev;
	u16 tx, rx;
	int result = -EINVAL;

	if (sscanf(value, "%15s %hu %hu", name, &tx, &rx) != 3)
		return -EINVAL;
	rtnl_lock();
	dev = __dev_get_by_name(&init_net, name);
	if (dev)
		result = count(dev, tx, rx);
	rtnl_unlock();
	return result;
}

static const struct kernel_param_ops can_counters_ops = { .set = can_counters_set };
module_param_cb(can_counters, &can_counters_ops, NULL, 0200);
MODULE_PARM_DESC(can_counters, "INTERFACE TX RX: error counters that a CAN controller's driver reports; 0 0: the chip's");
